"""Registration of a scan to a surface or a map: matching, Gauss-Newton, degeneracy, and the local map."""
