//! Errors, as Python exceptions.

use std::fmt::Display;

use pyo3::create_exception;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

create_exception!(
    parallax,
    ParallaxError,
    PyValueError,
    "Something that Parallax cannot use; the message says what, where, and what to do."
);

/// The exception that carries this error's message.
pub(crate) fn raise(error: impl Display) -> PyErr {
    ParallaxError::new_err(error.to_string())
}
