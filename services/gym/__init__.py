"""Gymnasium environments of the task; importing this registers them.

gymnasium.make("congrasp.services.gym:congrasp/Grasp-v0", hand="allegro")
"""

import gymnasium as gym

ID = "congrasp/Grasp-v0"
_MODULE = "congrasp.services.gym.vector_env"

gym.register(ID, entry_point=f"{_MODULE}:GraspEnv", vector_entry_point=f"{_MODULE}:GraspVectorEnv")
