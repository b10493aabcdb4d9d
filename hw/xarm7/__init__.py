"""A real xArm7 behind its vendor's SDK, which is used here and nowhere else. Millimetres end here too.

settings.py   the [xarm] table of a rig file        sdk.py       connections, and the SDK's traps
units.py      metres and quaternions ↔ the wire     telling.py   what the controller reports by itself
stop.py       STOP's own connection                 gripper.py   G1 and G2, in a thread of their own
start.py      from any state to servo mode          plant.py     hw.plant.Plant out of all of these
compare.py    a rig file against a controller (far doctor)
"""
