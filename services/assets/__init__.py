"""What people bring along: meshes, hand files, captured grasps; each becomes one of the project's own forms."""
