"""Whether states and motions are free of collision: compiled and conservative, and exact by coal."""
