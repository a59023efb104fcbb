"""Blender code: scene, materials, camera, renders and the evaluated mesh.

No other package imports ``bpy``. These modules change Blender's single open file, so a process holds one scene
at a time; ``build_scene`` replaces it.
"""
