"""Scenes of an engine on the CPU, each compiled on the first use of its object."""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from congrasp.actors.physics.scene import compile_scene
from congrasp.common.hands.spec import Hand
from congrasp.common.objects.spec import GraspObject
from congrasp.common.runtime.physics_library import mujoco
from congrasp.common.task.config import TaskConfig

Scene = TypeVar("Scene")


class CompiledObjects(Generic[Scene]):
    """Scenes of the objects by their index."""

    def __init__(
        self,
        hand: Hand,
        task: TaskConfig,
        objects: Sequence[GraspObject],
        convert: Callable[[mujoco.MjModel], Scene],
    ):
        """Compiles nothing yet.

        Args:
          hand: the hand.
          task: timing and collision settings.
          objects: the objects.
          convert: converts the compiled model of an object to the scene of an engine.
        """
        self._hand = hand
        self._task = task
        self._objects = objects
        self._convert = convert
        self._scenes: dict[int, Scene] = {}

    def __getitem__(self, index: int) -> Scene:
        """Returns the scene of an object."""
        if index not in self._scenes:
            model = compile_scene(self._hand, self._task, self._objects[index])
            self._scenes[index] = self._convert(model)
        return self._scenes[index]

    def replace(self, objects: Sequence[GraspObject]) -> None:
        """Replaces the objects; scenes that were returned stay valid."""
        self._objects = objects
        self._scenes.clear()
