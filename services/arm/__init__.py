"""A hand on an arm: inverse kinematics along a grasp motion, limits and collisions of the arm,
joint trajectories.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class ArmOptions:
    """An arm, its base and its limits; the string under a field is its help on the command
    line.
    """

    arm: str = ""
    """Arm that carries the hand: an MJCF or URDF file, or a robot of MuJoCo Menagerie (panda,
    ur5e). Attempts that the arm cannot execute are rejected."""
    base: str = "-0.7 0 0 0"
    """X Y Z YAW of the arm's base, in metres relative to the object on the table, and degrees."""
    flange: str = ""
    """Site or body of the arm to which the hand is attached; by default the site attachment_site,
    flange, tool0 or ee_site, or else the last body."""
    mount: str = ""
    """X Y Z ROLL PITCH YAW of the hand's wrist frame in the frame of the flange, in metres, and
    degrees about the flange's axes.
    """
    arm_speed: str = ""
    """Speed limits of the arm's joints in rad/s (m/s for prismatic joints): one number for all
    joints, or one for each. By default those of the URDF, or 3.14."""
