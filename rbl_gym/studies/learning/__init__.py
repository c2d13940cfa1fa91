"""Learning tasks: training, policies, evaluation on held-out worlds, transfer to filters."""
