"""The episode of one hand and one object over T control steps: one type for recordings, motion
files, pictures and exports.

`episode` has the type and its conversion to and from the message of recordings, `motion_file` reads
and writes it as NPZ, `mirrored` makes the episode of the other hand. `arm` is the arm that carries
the hand, `hand_arrays` the hand's joints, links and capsules, `constraints` the active constraints
and their markers, `message_checks` the validation of messages from untrusted peers.
"""
