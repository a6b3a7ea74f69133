//! Where on the surface the errors of many scans are, seen from the front.

use super::maps::{PixelMap, draw_maps};
use super::render::{ViewFrame, ViewSide};
use gv3_codec::mesh::TriMesh;
use gv3_codec::metrics::COVERAGE_LIMIT_MM;
use image::RgbImage;

/// Rows of the map.
const HEIGHT_PX: usize = 420;

/// Errors of scans' vertices gathered in the pixels of a front view, that of the first scan.
#[derive(Debug, Clone)]
pub struct ErrorMap {
    frame: ViewFrame,
    width_px: usize,
    pixels: Vec<Pixel>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Pixel {
    /// Whole numbers add up to the same in any order, and scans come in any.
    squared_sum_um2: u64,
    max_mm: f32,
    missing: u32,
    count: u32,
}

impl ErrorMap {
    /// A map in the view that fits a scan.
    pub fn new(scan: &TriMesh) -> Self {
        let frame = ViewFrame::fit(&[scan], ViewSide::default());
        let width_px = ((HEIGHT_PX as f32 * frame.aspect()) as usize).clamp(HEIGHT_PX / 4, HEIGHT_PX * 2);
        Self { frame, width_px, pixels: vec![Pixel::default(); width_px * HEIGHT_PX] }
    }

    /// Adds the errors of a scan's vertices, infinite where nothing was decoded.
    ///
    /// # Panics
    /// When there is not one error a vertex.
    pub fn add(&mut self, scan: &TriMesh, error_mm: &[f32]) {
        assert_eq!(scan.vertex_count(), error_mm.len(), "one error a vertex");
        for (&p, &error_mm) in scan.positions_mm.iter().zip(error_mm) {
            let at = self.frame.project(p, self.width_px, HEIGHT_PX);
            if !(at.x >= 0.0 && at.y >= 0.0) {
                continue;
            }
            let (x, y) = (at.x as usize, at.y as usize);
            if x >= self.width_px || y >= HEIGHT_PX {
                continue;
            }
            let pixel = &mut self.pixels[y * self.width_px + x];
            pixel.count += 1;
            pixel.missing += u32::from(error_mm > COVERAGE_LIMIT_MM);
            if error_mm.is_finite() {
                pixel.squared_sum_um2 += (1e6 * f64::from(error_mm) * f64::from(error_mm)) as u64;
                pixel.max_mm = pixel.max_mm.max(error_mm);
            }
        }
    }

    /// Three maps side by side: root mean square, largest error, and share of vertices farther than 2 mm.
    pub fn draw(&self, caption: &str) -> RgbImage {
        let values = |value: fn(&Pixel) -> f32| -> Vec<f32> {
            self.pixels.iter().map(|p| if p.count > 0 { value(p) } else { f32::NAN }).collect()
        };
        let rms = values(Pixel::rms_mm);
        let max = values(|p| p.max_mm);
        let missing = values(|p| 100.0 * p.missing as f32 / p.count as f32);
        let maps = [("rms, mm", &rms), ("largest, mm", &max), ("above 2 mm, %", &missing)];
        let maps = maps.map(|(title, values)| PixelMap { title, values });
        draw_maps(&maps, self.width_px as u32, caption)
    }
}

impl Pixel {
    fn rms_mm(&self) -> f32 {
        (self.squared_sum_um2 as f64 * 1e-6 / f64::from(self.count)).sqrt() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn errors_are_gathered_where_they_are() {
        let mesh = TriMesh {
            positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::ONE.with_z(0.0), Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            uv: None,
        };
        let mut map = ErrorMap::new(&mesh);
        map.add(&mesh, &[0.3, 0.0, 3.0, f32::INFINITY]);
        map.add(&mesh, &[0.4, 0.0, 0.0, 0.0]);
        let found: Vec<&Pixel> = map.pixels.iter().filter(|p| p.count > 0).collect();
        assert_eq!(found.len(), 4);
        assert!(found.iter().all(|p| p.count == 2));
        // The upper row of the picture is +y: vertices 3 and 2, then 0 and 1.
        assert_eq!(found.iter().map(|p| p.missing).collect::<Vec<_>>(), [1, 1, 0, 0]);
        assert_eq!((found[1].max_mm, found[2].max_mm), (3.0, 0.4));
        assert!((found[2].rms_mm() - 0.125f32.sqrt()).abs() < 1e-5);
        assert!(map.draw("all").width() > 3 * 420);
    }
}
