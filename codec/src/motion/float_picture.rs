//! A picture of real numbers: normalised grey levels, depth, relief.

use crate::GreyPicture;

/// Picture of `f32`, row-major, first row on top.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FloatPicture {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// `width_px * height_px` values.
    pub pixels: Vec<f32>,
}

impl FloatPicture {
    /// A picture from its values.
    ///
    /// # Panics
    /// When `pixels.len() != width_px * height_px`.
    pub fn new(width_px: u32, height_px: u32, pixels: Vec<f32>) -> Self {
        assert_eq!(pixels.len(), width_px as usize * height_px as usize, "picture size and data differ");
        Self { width_px, height_px, pixels }
    }
}

impl From<&GreyPicture> for FloatPicture {
    fn from(grey: &GreyPicture) -> Self {
        Self::new(grey.width_px, grey.height_px, grey.pixels.iter().map(|&p| f32::from(p)).collect())
    }
}
