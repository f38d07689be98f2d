//! The bridge between a node and a router, as two peers see it: one on `sinew-ros2-core`, and Python's
//! `zenoh_ros2_sdk` and `rosbags`. All on loopback.
//!
//! `SINEW_ROS_PYTHON` names a Python that has `zenoh-ros2-sdk` and `rosbags` of PyPI; without them these tests are
//! skipped and report it.

mod commands;
mod python;
mod services;
mod stage;
mod topics;
