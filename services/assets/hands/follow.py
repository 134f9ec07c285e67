"""A joint of a model that follows another one."""

from typing import NamedTuple


class Follow(NamedTuple):
    """Joint a = offset + ratio * joint b, by their indices in the model.

    Angles are relative to the pose of the file.
    """

    a: int
    b: int
    ratio: float
    offset: float

    def reversed(self) -> "Follow":
        """Returns the same with b as the follower."""
        return Follow(self.b, self.a, 1.0 / self.ratio, -self.offset / self.ratio)

    def through(self, leader: "Follow") -> "Follow":
        """Returns the same with the leader of b instead of b."""
        return Follow(
            a=self.a,
            b=leader.b,
            ratio=self.ratio * leader.ratio,
            offset=self.offset + self.ratio * leader.offset,
        )
