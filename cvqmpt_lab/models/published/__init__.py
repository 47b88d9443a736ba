"""The sequence model as published, and the importer of its checkpoints."""
