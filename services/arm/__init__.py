"""A hand on an arm: inverse kinematics along a grasp motion, limits and collisions of the arm, joint trajectories."""
