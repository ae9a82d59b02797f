//! Lists of numbers as numpy arrays.

use numpy::{Element, PyArray1, PyArrayMethods};
use pyo3::prelude::*;

/// A row-major array of this shape.
///
/// # Errors
///
/// When `values` does not fill the shape.
pub(crate) fn array<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    shape: impl Into<Vec<usize>>,
) -> PyResult<Bound<'py, PyAny>> {
    Ok(PyArray1::from_vec(py, values).reshape(shape.into())?.into_any())
}

/// A list as an array of one axis.
pub(crate) fn list<T: Element>(py: Python<'_>, values: Vec<T>) -> Bound<'_, PyAny> {
    PyArray1::from_vec(py, values).into_any()
}
