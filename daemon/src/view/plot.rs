//! Plots of a number over time as SVG.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Size of a plot.
const SIZE_PX: (u32, u32) = (1000, 480);
/// Line colours that stay apart for colour-blind eyes (M. Okabe and K. Ito, 2008), then three more for crowded plots.
pub(super) const COLOURS: [RGBColor; 9] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(110, 112, 120),
    RGBColor(120, 60, 160),
    RGBColor(150, 110, 60),
];
/// Left edge of title and legend.
pub(super) const MARGIN_PX: i32 = 24;
/// Strip of title and legend.
const HEAD_PX: i32 = 88;
pub(super) const INK: RGBColor = RGBColor(40, 42, 48);
pub(super) const GRID: RGBColor = RGBColor(226, 227, 231);
const GAP: RGBColor = RGBColor(244, 225, 222);

/// A number over time.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// (seconds, value), sorted by time; the line is broken where a value is not finite.
    pub points: Vec<(f64, f64)>,
}

/// Events along the time axis.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Marks {
    /// Times of keyframes, seconds: dots on the first series.
    pub keyframes_s: Vec<f64>,
    /// Spans without scans, seconds: shaded bands.
    pub gaps_s: Vec<(f64, f64)>,
}

/// The error of a replay over time as SVG text; values are plotted from zero.
///
/// # Errors
/// A message of the drawing library; drawing to memory gives none.
pub fn error_over_time(series: &[Series], marks: &Marks, title: &str, y_label: &str) -> Result<String, String> {
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
    draw(&root, series, marks, [title, y_label]).and_then(|()| root.present()).map_err(|e| e.to_string())?;
    drop(root);
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type DrawResult<'a> = Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>>;

fn draw<'a>(root: &Area<'a>, series: &[Series], marks: &Marks, [title, y_label]: [&str; 2]) -> DrawResult<'a> {
    root.fill(&WHITE)?;
    draw_head(root, title, series, marks)?;
    let ((start_s, end_s), top) = bounds(series, marks);
    let mut chart = ChartBuilder::on(root)
        .margin(16)
        .margin_top(HEAD_PX)
        .margin_right(28)
        .x_label_area_size(48)
        .y_label_area_size(76)
        .build_cartesian_2d(start_s..end_s, 0.0..top)?;
    // Gaps lie under the grid, so they are drawn before it.
    for &(from_s, to_s) in &marks.gaps_s {
        chart.draw_series([Rectangle::new([(from_s, 0.0), (to_s, top)], GAP.filled())])?;
    }
    let decimals = (-(top / 7.0).log10().floor()).clamp(0.0, 9.0) as usize;
    chart
        .configure_mesh()
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .axis_style(INK)
        .label_style(("sans-serif", 16).into_font().color(&INK))
        .axis_desc_style(("sans-serif", 18).into_font().color(&INK))
        .x_desc("time, s")
        .y_desc(y_label)
        .x_labels(11)
        .y_labels(7)
        .x_label_formatter(&|x| trimmed(*x, 3))
        .y_label_formatter(&|y| format!("{y:.decimals$}"))
        .draw()?;
    for (one, colour) in series.iter().zip(COLOURS.iter().cycle()) {
        for run in one.points.split(|p| !p.1.is_finite()) {
            chart.draw_series(LineSeries::new(run.iter().copied(), colour.stroke_width(2)))?;
        }
    }
    let first = series.first().map_or(&[][..], |one| &one.points);
    let dots = marks.keyframes_s.iter().filter_map(|&t| Some((t, value_at(first, t)?)));
    chart.draw_series(dots.map(|point| Circle::new(point, 4, COLOURS[0].filled())))?;
    Ok(())
}

/// Title and under it one row of names, so that no line is covered.
fn draw_head<'a>(root: &Area<'a>, title: &str, series: &[Series], marks: &Marks) -> DrawResult<'a> {
    root.draw(&Text::new(title.to_owned(), (MARGIN_PX, 16), ("sans-serif", 24).into_font().color(&INK)))?;
    let y = HEAD_PX - 24;
    let mut x = MARGIN_PX;
    let mut label = |root: &Area<'a>, name: &str| {
        let style = ("sans-serif", 16).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
        let left_px = x;
        // Letters are about half as wide as high; a viewer's font may differ, so there is room between the names.
        x += 32 + name.chars().count() as i32 * 8 + 26;
        root.draw(&Text::new(name.to_owned(), (left_px + 32, y), style)).map(|()| left_px)
    };
    for (one, colour) in series.iter().zip(COLOURS.iter().cycle()) {
        let x = label(root, &one.name)?;
        root.draw(&PathElement::new([(x, y), (x + 24, y)], colour.stroke_width(2)))?;
    }
    if !marks.keyframes_s.is_empty() {
        let x = label(root, "keyframe")?;
        root.draw(&Circle::new((x + 12, y), 4, COLOURS[0].filled()))?;
    }
    if !marks.gaps_s.is_empty() {
        let x = label(root, "no scans")?;
        root.draw(&Rectangle::new([(x, y - 7), (x + 24, y + 7)], GAP.filled()))?;
    }
    Ok(())
}

/// Extent of time and a top for the values with room above them.
fn bounds(series: &[Series], marks: &Marks) -> ((f64, f64), f64) {
    let points = || series.iter().flat_map(|s| &s.points).filter(|p| p.0.is_finite() && p.1.is_finite());
    let gap_ends = marks.gaps_s.iter().flat_map(|g| [g.0, g.1]);
    let times = points().map(|p| p.0).chain(gap_ends);
    let (start, end) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)));
    let top = points().fold(0.0_f64, |top, p| top.max(p.1)) * 1.08;
    let span = if start < end {
        (start, end)
    } else if start.is_finite() {
        (start, start + 1.0)
    } else {
        (0.0, 1.0)
    };
    (span, if top > 0.0 { top } else { 1.0 })
}

/// Value at a time, on the line between the points around it.
fn value_at(points: &[(f64, f64)], time_s: f64) -> Option<f64> {
    let after = points.partition_point(|p| p.0 < time_s);
    let b = points.get(after)?;
    let a = points[after.saturating_sub(1)];
    let share = if b.0 > a.0 { ((time_s - a.0) / (b.0 - a.0)).max(0.0) } else { 1.0 };
    let value = if share >= 1.0 { b.1 } else { a.1 + (b.1 - a.1) * share };
    value.is_finite().then_some(value)
}

/// A number with at most `decimals` decimals and no zeros at its end.
fn trimmed(x: f64, decimals: usize) -> String {
    let text = format!("{x:.decimals$}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(name: &str, height: f64) -> Series {
        let points = (0..=20).map(|i| (f64::from(i) * 0.1, height * (1.0 + (f64::from(i) * 0.7).sin()))).collect();
        Series { name: name.into(), points }
    }

    #[test]
    fn the_plot_names_its_axes_series_and_marks() {
        let marks = Marks { keyframes_s: vec![0.0, 1.0, 2.0], gaps_s: vec![(0.45, 0.65)] };
        let svg = error_over_time(&[wave("rms", 0.01), wave("99 %", 0.03)], &marks, "talk", "error, mm").unwrap();
        for text in ["talk", "time, s", "error, mm", "rms", "99 %", "keyframe", "no scans"] {
            assert!(svg.lines().any(|line| line.trim() == text), "{text} is missing");
        }
        let wide = svg.lines().filter(|line| line.contains("<polyline") && line.contains("stroke-width=\"2\""));
        assert_eq!(wide.count(), 2 + 2, "two lines and their legend");
        assert_eq!(svg.matches("<circle").count(), 3 + 1);
        assert!(svg.trim_end().ends_with("</svg>"));
    }

    #[test]
    fn names_are_escaped() {
        let svg = error_over_time(&[wave("a < b & c", 1.0)], &Marks::default(), "t", "y").unwrap();
        assert!(svg.contains("a &lt; b &amp; c"));
    }

    #[test]
    fn empty_constant_and_broken_series_are_drawn() {
        error_over_time(&[], &Marks::default(), "", "").unwrap();
        let flat = Series { name: "zero".into(), points: vec![(3.0, 0.0)] };
        let broken =
            Series { name: "broken".into(), points: vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 1.0), (3.0, 2.0)] };
        let marks = Marks { keyframes_s: vec![1.0, 9.0], gaps_s: vec![] };
        let svg = error_over_time(&[flat, broken], &marks, "t", "y").unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }

    #[test]
    fn values_between_points_lie_on_the_line() {
        let points = [(0.0, 1.0), (2.0, 3.0), (3.0, f64::NAN)];
        assert_eq!(value_at(&points, 0.0), Some(1.0));
        assert_eq!(value_at(&points, 1.0), Some(2.0));
        assert_eq!(value_at(&points, 2.0), Some(3.0));
        assert_eq!(value_at(&points, 2.5), None);
        assert_eq!(value_at(&points, 9.0), None);
        assert_eq!((trimmed(1.50, 3), trimmed(10.0, 3)), ("1.5".to_owned(), "10".to_owned()));
    }
}
