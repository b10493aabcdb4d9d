"""The session: drives far_app/trial.py in real time (or in lockstep) and keeps its state.

session      Session: trials at 30 Hz under one operator
supervision  what may interrupt a trial at any tick
planners     LockstepPlanner, ThreadedPlanner
adaptation   BackgroundAdaptation
watching     WatchingDetector: a learned success detector in a thread of its own
shadow       ShadowRobot: plans are made and shown, the arm is held
lockstep     run_lockstep: the same trial, as fast as the machine goes
"""
