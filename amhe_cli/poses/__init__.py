"""Floor 1: where trunk and box are: motion capture in its several dialects, behind one interface."""
