//! What plots and pages are made of: SVG elements, axes, numbers as people read them, one style for all.

pub mod axis;
pub mod draw;
pub mod format;
pub mod page;
