"""Floor 0, the words of the house: plain values and arithmetic, no files, no simulator."""
