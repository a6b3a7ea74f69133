//! Motion over time.

pub mod spline;
