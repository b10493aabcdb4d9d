"""Recordings to other programs' formats, and their demonstrations to ours. The formats are described in docs/data.md.

rollout    a recorded attempt, or the recovery in it, as arrays with everything known of it
select     which attempts of which sessions
lerobot    LeRobotDataset v3, written; lerobot_read reads one
robomimic  robomimic HDF5, written; robomimic_read reads one
target     a file or folder that is there whole or not at all, and never overwritten by accident
"""
