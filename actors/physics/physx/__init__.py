"""PhysX as an engine: the scene that MuJoCo compiles, simulated by PhysX on the CPU.

Bodies, shapes, joints, servos and masses are read from the compiled model, so that both engines
simulate the same numbers. The binding is `sapien`.
"""
