//! Pictures of meshes and plots of errors.
