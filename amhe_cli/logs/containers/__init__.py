"""Files that hold messages: MCAP, rosbag2, ROS 1 bags; as raw batches, with damage reported."""
