"""A SpaceMouse or gamepad at the robot PC, read byte by byte from the kernel: no library, no daemon.

settings.py    the rig file's [input_device] table
spacemouse.py  HID reports (hidraw)      gamepad.py  input events (evdev)      both: a Decoder
reader.py      the thread that reads one and says what it asks for
"""
