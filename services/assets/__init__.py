"""Importers of user files (meshes, hand files, captured grasps), and downloads of policies."""
