"""The Go1's state from joints, IMU and poses."""
