"""Poses of trunk and box: motion capture in several protocols, behind one interface."""
