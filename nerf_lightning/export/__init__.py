"""Export of runs: compact files, meshes, points, voxels, web pages and posed photos."""
