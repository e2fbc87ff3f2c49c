"""Registration of volumes: files with orientation and spacing, landmarks in space, warps in blocks, fields, pages.

Landmarks and what is said of them are in the coordinates of the files, LPS in millimetres as a rule. Inside, maps have
coordinates in units of the finest spacing of the fixed volume, so that what is a pixel for pictures is about a voxel.
"""
