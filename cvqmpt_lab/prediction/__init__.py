"""From observation to sampling distribution: what stands between the models (torch) and the planners."""
