"""The session: drives far_app/trial.py in real time (or in lockstep) and keeps its state.

session      Session: trials at 30 Hz under one operator
settings     how a session runs, and what became of its trials
standing     its state, what the operator is told, an arm that is held
supervision  what may interrupt a trial at any tick
operator     what the operator asks: refused with a reason, or obeyed
lessons      what a trial learns from its failed attempts
planners     LockstepPlanner, ThreadedPlanner
adaptation   BackgroundAdaptation
watching     WatchingDetector: a learned success detector in a thread of its own
shadow       ShadowRobot: plans are made and shown, the arm is held
lockstep     run_lockstep: the same trial, as fast as the machine goes
"""
