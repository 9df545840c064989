"""Reader of ROS bags: ROS 1 ``.bag``, ROS 2 folders, and bare ``.mcap`` and ``.db3`` files."""
