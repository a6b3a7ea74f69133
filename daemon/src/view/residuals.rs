//! Picture of reprojection errors: where they are in both image planes and how they scatter, coloured by view.

use crate::light::calibrate::{Residual, ViewResiduals};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

const SIZE_PX: (u32, u32) = (1240, 1000);
/// Left and top edges of the panels' columns and rows, and their sizes.
const COLUMNS_PX: [i32; 2] = [40, 560];
const ROWS_PX: [i32; 2] = [110, 560];
const PANEL_PX: [i32; 2] = [470, 380];
const LEGEND_PX: [i32; 2] = [1060, 110];
/// Views named in the legend at most.
const LEGEND_VIEWS: usize = 40;
/// Length of a long arrow (nine of ten are shorter), on paper.
const ARROW_PX: f64 = 26.0;
const INK: RGBColor = RGBColor(40, 42, 48);
const FRAME: RGBColor = RGBColor(160, 163, 170);

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type DrawResult<'a> = Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>>;

/// A device's errors, by view.
struct Device<'a> {
    name: &'static str,
    size_px: [u32; 2],
    views: Vec<&'a [Residual]>,
}

/// Errors of camera (left) and projector (right) as SVG text: arrows from the measured pixel towards measured minus projected,
/// enlarged, above; the errors themselves below. Rejected corners are crosses. Sizes are columns and rows.
///
/// # Errors
/// A message of the drawing library; drawing to memory gives none.
pub fn residual_picture(
    views: &[ViewResiduals],
    camera_size_px: [u32; 2],
    projector_size_px: [u32; 2],
) -> Result<String, String> {
    let devices = [
        Device { name: "camera", size_px: camera_size_px, views: views.iter().map(|v| &v.camera[..]).collect() },
        Device {
            name: "projector",
            size_px: projector_size_px,
            views: views.iter().map(|v| &v.projector[..]).collect(),
        },
    ];
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
    draw(&root, &devices, views).and_then(|()| root.present()).map_err(|e| e.to_string())?;
    drop(root);
    Ok(svg)
}

fn draw<'a>(root: &Area<'a>, devices: &[Device; 2], views: &[ViewResiduals]) -> DrawResult<'a> {
    root.fill(&WHITE)?;
    text(
        root,
        "Reprojection errors: measured minus projected; crosses are not used",
        (COLUMNS_PX[0], 34),
        24,
        HPos::Left,
    )?;
    for (device, left) in devices.iter().zip(COLUMNS_PX) {
        draw_arrows(root, device, [left, ROWS_PX[0]])?;
        draw_scatter(root, device, [left, ROWS_PX[1]])?;
    }
    for (i, view) in views.iter().enumerate().take(LEGEND_VIEWS) {
        let y = LEGEND_PX[1] + 20 * i as i32;
        root.draw(&Circle::new((LEGEND_PX[0], y), 5, colour(i, views.len()).filled()))?;
        text(root, &view.name, (LEGEND_PX[0] + 14, y), 14, HPos::Left)?;
    }
    if let Some(more) = views.len().checked_sub(LEGEND_VIEWS + 1) {
        let y = LEGEND_PX[1] + 20 * LEGEND_VIEWS as i32;
        text(root, &format!("and {} more", more + 1), (LEGEND_PX[0], y), 14, HPos::Left)?;
    }
    Ok(())
}

/// The device's picture with an arrow at every corner.
fn draw_arrows<'a>(root: &Area<'a>, device: &Device, [left, top]: [i32; 2]) -> DrawResult<'a> {
    let [w, h] = device.size_px.map(f64::from);
    let scale = (f64::from(PANEL_PX[0]) / w).min(f64::from(PANEL_PX[1]) / h);
    // Pixel centres are whole numbers: the picture begins half a pixel before the first.
    let at = |[x, y]: [f64; 2]| (left + ((x + 0.5) * scale) as i32, top + ((y + 0.5) * scale) as i32);
    let enlarged = device.long_error().map_or(1.0, |long| nice(ARROW_PX / (scale * long)));
    let title = format!("{}, {w} x {h} pixels, errors x {enlarged}", device.name);
    text(root, &title, (left, top - 16), 16, HPos::Left)?;
    root.draw(&Rectangle::new([at([-0.5, -0.5]), at([w - 0.5, h - 0.5])], FRAME.stroke_width(1)))?;
    for (i, view) in device.views.iter().enumerate() {
        let colour = colour(i, device.views.len());
        for r in view.iter().filter(|r| r.at_px.iter().chain(&r.error_px).all(|v| v.is_finite())) {
            let ([x, y], [dx, dy]) = (r.at_px, r.error_px);
            if r.rejected {
                draw_cross(root, at(r.at_px), &colour)?;
                continue;
            }
            root.draw(&Circle::new(at(r.at_px), 1, colour.filled()))?;
            let tip = at([x + enlarged * dx, y + enlarged * dy]);
            root.draw(&PathElement::new([at(r.at_px), tip], colour.stroke_width(1)))?;
        }
    }
    Ok(())
}

/// The errors about their origin; those beyond the border are drawn on it.
fn draw_scatter<'a>(root: &Area<'a>, device: &Device, [left, top]: [i32; 2]) -> DrawResult<'a> {
    let half = PANEL_PX[1] / 2;
    let centre = (left + PANEL_PX[0] / 2, top + half);
    // Twice the long errors is about four standard deviations of normal ones.
    let circle_px = nice(2.0 * device.long_error().unwrap_or(1.0));
    let scale = f64::from(half) / (2.2 * circle_px);
    let rms_px = device.rms_px();
    let title = format!("{}, rms {rms_px:.3} px, circles at {circle_px} and {} px", device.name, 2.0 * circle_px);
    text(root, &title, (left, top - 8), 16, HPos::Left)?;
    for n in 1..=2 {
        root.draw(&Circle::new(centre, (f64::from(n) * circle_px * scale) as i32, FRAME.stroke_width(1)))?;
    }
    root.draw(&PathElement::new([(centre.0 - half, centre.1), (centre.0 + half, centre.1)], FRAME.stroke_width(1)))?;
    root.draw(&PathElement::new([(centre.0, centre.1 - half), (centre.0, centre.1 + half)], FRAME.stroke_width(1)))?;
    let along = |v: f64| (v * scale).clamp(-f64::from(half), f64::from(half)) as i32;
    for (i, view) in device.views.iter().enumerate() {
        let colour = colour(i, device.views.len());
        for r in view.iter().filter(|r| r.error_px.iter().all(|v| v.is_finite())) {
            let at = (centre.0 + along(r.error_px[0]), centre.1 + along(r.error_px[1]));
            if r.rejected {
                draw_cross(root, at, &colour)?;
            } else {
                root.draw(&Circle::new(at, 2, colour.filled()))?;
            }
        }
    }
    Ok(())
}

impl Device<'_> {
    fn used_lengths(&self) -> Vec<f64> {
        let used = self.views.iter().flat_map(|v| v.iter()).filter(|r| !r.rejected);
        let mut lengths: Vec<f64> =
            used.map(|r| r.error_px[0].hypot(r.error_px[1])).filter(|l| l.is_finite()).collect();
        lengths.sort_unstable_by(f64::total_cmp);
        lengths
    }

    /// Length that nine of ten errors stay below, px.
    fn long_error(&self) -> Option<f64> {
        let lengths = self.used_lengths();
        lengths.get(lengths.len() * 9 / 10).copied().filter(|&l| l > 1e-9)
    }

    fn rms_px(&self) -> f64 {
        let lengths = self.used_lengths();
        (lengths.iter().map(|l| l * l).sum::<f64>() / lengths.len().max(1) as f64).sqrt()
    }
}

/// One, two or five times a power of ten, the nearest below.
fn nice(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    let digit = [5.0, 2.0].into_iter().find(|d| d * power <= value).unwrap_or(1.0);
    // Through its decimals, so that it reads 0.2 and not 0.20000000000000001.
    format!("{:e}", digit * power).parse().map_or(value, |v: f64| (v * 1e9).round() / 1e9)
}

/// Hues around the circle, a view each, neighbours far apart.
fn colour(view: usize, views: usize) -> HSLColor {
    let turns = view as f64 * 0.618_033_988_749_895;
    let hue = if views > 12 { turns.fract() } else { view as f64 / views.max(1) as f64 };
    HSLColor(hue, 0.75, if view.is_multiple_of(2) { 0.42 } else { 0.55 })
}

fn draw_cross<'a>(root: &Area<'a>, (x, y): (i32, i32), colour: &HSLColor) -> DrawResult<'a> {
    root.draw(&PathElement::new([(x - 5, y - 5), (x + 5, y + 5)], colour.stroke_width(2)))?;
    root.draw(&PathElement::new([(x - 5, y + 5), (x + 5, y - 5)], colour.stroke_width(2)))
}

fn text<'a>(root: &Area<'a>, text: &str, at: (i32, i32), size: i32, align: HPos) -> DrawResult<'a> {
    let style = ("sans-serif", size).into_font().color(&INK).pos(Pos::new(align, VPos::Center));
    root.draw(&Text::new(text.to_owned(), at, style))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(name: &str, error_px: f64) -> ViewResiduals {
        let residual = |i: usize| Residual {
            at_px: [40.0 + 50.0 * (i % 4) as f64, 40.0 + 50.0 * (i / 4) as f64],
            error_px: [error_px * (i as f64).sin(), error_px * (i as f64).cos()],
            rejected: i == 5,
        };
        let all: Vec<Residual> = (0..12).map(residual).collect();
        ViewResiduals { name: name.into(), camera: all.clone(), projector: all }
    }

    #[test]
    fn the_picture_names_devices_and_views_and_draws_every_corner() {
        let svg = residual_picture(&[view("a < b", 0.2), view("second", 0.3)], [640, 480], [912, 1140]).unwrap();
        for words in ["camera, 640 x 480 pixels, errors x", "projector, rms 0.", "a &lt; b", "second"] {
            assert!(svg.contains(words), "{words} is missing");
        }
        // Dots of both panels of both devices, legend and rings.
        assert_eq!(svg.matches("<circle").count(), 2 * 2 * 2 * 11 + 2 + 4);
        assert!(svg.trim_end().ends_with("</svg>") && !svg.contains("NaN"));
    }

    #[test]
    fn nothing_and_not_a_number_are_drawn_too() {
        residual_picture(&[], [640, 480], [912, 1140]).unwrap();
        let views: Vec<ViewResiduals> =
            (0..50).map(|i| view(&format!("v{i}"), if i == 3 { f64::NAN } else { 0.0 })).collect();
        let svg = residual_picture(&views, [640, 480], [912, 1140]).unwrap();
        assert!(svg.contains("and 10 more") && !svg.contains("NaN"));
    }

    #[test]
    fn scales_are_round_numbers() {
        assert_eq!([0.37, 0.2, 7.0, 1.0, 129.0, 0.051].map(nice), [0.2, 0.2, 5.0, 1.0, 100.0, 0.05]);
    }
}
