"""The Unitree Go1 that pushes boxes: model, plant, gaits, tasks, link, motion capture and emulator."""
