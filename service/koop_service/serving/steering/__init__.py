"""Bringing a trajectory to a target: from what is asked to a plan, from plans to a task.

Each file knows only those before it: aims, planning, courses, fitness, outset, tasks, commander.
"""
