"""From files to objects: finding, reading, mending, scaling and cutting meshes."""
