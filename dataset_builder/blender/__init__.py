"""Everything that needs Blender: the scene, its materials, the camera, the renders, the evaluated mesh.

No other package imports ``bpy``. These modules change Blender's one open file, so a process holds one scene
at a time: ``build_scene`` starts it anew.
"""
