"""From files to objects: finding, reading, repairing, scaling and decomposing meshes."""
