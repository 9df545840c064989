"""One point cloud before it is compared with another: motion compensation, voxels, k-d tree, ground, normals, maps."""
