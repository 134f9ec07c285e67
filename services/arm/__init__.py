"""A hand on an arm: inverse kinematics along a grasp motion, limits and collisions of the arm,
joint trajectories.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class ArmOptions:
    """An arm and its place; the string under a field is its help on the command line."""

    arm: str = ""
    """Arm that carries the hand: an MJCF or URDF file, or a robot of MuJoCo Menagerie (panda,
    ur5e). Attempts that it cannot do are rejected."""
    base: str = "-0.7 0 0 0"
    """X Y Z YAW of the arm's base: metres from the object on the table, degrees."""
    flange: str = ""
    """Site or body of the arm that carries the hand; by default the site attachment_site, flange,
    tool0 or ee_site, or the last body."""
    mount: str = ""
    """X Y Z ROLL PITCH YAW from the flange to the hand's wrist frame: metres, degrees about the
    flange's axes.
    """
    arm_speed: str = ""
    """Speed limits of the arm's joints, rad/s (m/s of slides): one for all, or one for each; by
    default those of the URDF, or 3.14."""
