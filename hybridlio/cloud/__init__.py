"""Processing of single point clouds: motion compensation, voxels, k-d tree, ground, normals, planes, vertex maps."""
