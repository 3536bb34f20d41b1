"""Middleware: ROS 2's messages by DDS, a ROS 1 node, motion capture.

Optional packages: `pip install 'knode-cosserat-hardware[dds,mocap,ros]'`. They are imported on first use.
"""
