"""A controller that speaks an xArm7's protocols over loopback, for the unmodified SDK: no arm needed to try the path.

    protocol.py     frames of the command port           arm.py        modes, states, errors, servo motion
    gripper.py      a G1 or G2 behind RS485              commands.py   what each request does
    reports.py      frames of the report ports           faults.py     what can be made to go wrong
    controller.py   sockets                              control.py    from outside: faults in, what was received out

`python -m hw.fake_xarm` or `far fake-xarm` runs it. Its motion is a model: real thresholds of errors, real dynamics and
what a real controller's state is after an error are not knowable without one.
"""
