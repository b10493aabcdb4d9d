"""The two long computations of a lesson, candidates and the update, and where they are made.

    protocol.py    Work: what they are
    here.py        in this process, on threads
    process.py     in a process of their own, from where they are asked for
    server.py      that process
    messages.py    what travels between the two

A learning thread holds its interpreter between two operations. If it loses its core just then, everything else in that
process waits until it has one again, the control loop too. In a process of its own it keeps nobody waiting, and nobody
keeps it waiting. Chosen by far_app/cli, used by far_app/methods.
"""
