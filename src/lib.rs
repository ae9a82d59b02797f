//! The library face of Parallax.
