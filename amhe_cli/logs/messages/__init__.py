"""Message definitions, their layout in memory, decoding and writing."""
