//! The native half of the Python package `parallax`: recordings, programs, systems and graphs as Python reads them.
//!
//! The module is private to the package ([`parallax._native`](../python/parallax)); it hands over plain dictionaries,
//! numpy arrays and JSON, and what they mean to people is written in Python. Every error of the crates below becomes a
//! Python exception that carries the same message.

mod arrays;
mod augment;
mod batch;
mod compiled;
mod episodes;
mod error;
mod gate;
mod graph;
mod live;
mod program;
mod recording;
mod run;
mod system;
mod worker;

use pyo3::prelude::*;

/// The module `parallax._native`.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::compiled::NativeCompiled;
    #[pymodule_export]
    use crate::episodes::NativeEpisodes;
    #[pymodule_export]
    use crate::error::ParallaxError;
    #[pymodule_export]
    use crate::graph::{NativeGraph, graphs, kinds};
    #[pymodule_export]
    use crate::live::{read_node, reset_state, set_parameters};
    #[pymodule_export]
    use crate::program::{NativeProgram, models};
    #[pymodule_export]
    use crate::recording::{data, load, trajectories};
    #[pymodule_export]
    use crate::run::NativeRun;
    #[pymodule_export]
    use crate::system::system;
    #[pymodule_export]
    use crate::worker::work;

    use super::{Bound, PyModule, PyModuleMethods, PyResult};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
