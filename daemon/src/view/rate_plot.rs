//! Plots of errors over rates as SVG, both axes logarithmic.

use super::plot::{COLOURS, GRID, INK, MARGIN_PX, Series};
use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::ops::Range;

const SIZE_PX: (u32, u32) = (1000, 620);
const TITLE_PX: i32 = 56;
/// Height and columns of the legend's rows.
const ROW_PX: i32 = 24;
const COLUMNS: usize = 4;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type DrawResult<'a> = Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>>;

/// Curves through points (x, y) as SVG text; points that are not positive numbers are left out.
///
/// # Errors
/// A message of the drawing library; drawing to memory gives none.
pub fn rate_plot(series: &[Series], title: &str, x_label: &str, y_label: &str) -> Result<String, String> {
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
    draw(&root, series, [title, x_label, y_label]).and_then(|()| root.present()).map_err(|e| e.to_string())?;
    drop(root);
    Ok(svg)
}

fn draw<'a>(root: &Area<'a>, series: &[Series], [title, x_label, y_label]: [&str; 3]) -> DrawResult<'a> {
    root.fill(&WHITE)?;
    root.draw(&Text::new(title.to_owned(), (MARGIN_PX, 16), ("sans-serif", 24).into_font().color(&INK)))?;
    let drawable = |p: &&(f64, f64)| [p.0, p.1].iter().all(|v| v.is_finite() && *v > 0.0);
    let points = || series.iter().flat_map(|s| &s.points).filter(drawable);
    let rows = series.len().div_ceil(COLUMNS) as i32;
    let mut chart = ChartBuilder::on(root)
        .margin(16)
        .margin_top(TITLE_PX + ROW_PX * rows + 12)
        .margin_right(28)
        .x_label_area_size(48)
        .y_label_area_size(76)
        .build_cartesian_2d(axis(points().map(|p| p.0)), axis(points().map(|p| p.1)))?;
    chart
        .configure_mesh()
        .bold_line_style(GRID)
        .light_line_style(TRANSPARENT)
        .axis_style(INK)
        .label_style(("sans-serif", 16).into_font().color(&INK))
        .axis_desc_style(("sans-serif", 18).into_font().color(&INK))
        .x_desc(x_label)
        .y_desc(y_label)
        .x_label_formatter(&|x| plain(*x))
        .y_label_formatter(&|y| plain(*y))
        .draw()?;
    for (one, colour) in series.iter().zip(COLOURS.iter().cycle()) {
        let points: Vec<(f64, f64)> = one.points.iter().filter(drawable).copied().collect();
        chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
        chart.draw_series(points.iter().map(|&p| Circle::new(p, 4, colour.filled())))?;
    }
    for (i, (one, colour)) in series.iter().zip(COLOURS.iter().cycle()).enumerate() {
        let x = MARGIN_PX + (i % COLUMNS) as i32 * (SIZE_PX.0 as i32 - 2 * MARGIN_PX) / COLUMNS as i32;
        let y = TITLE_PX + (i / COLUMNS) as i32 * ROW_PX + ROW_PX / 2;
        let style = ("sans-serif", 16).into_font().color(&INK).pos(Pos::new(HPos::Left, VPos::Center));
        root.draw(&PathElement::new([(x, y), (x + 24, y)], colour.stroke_width(2)))?;
        root.draw(&Circle::new((x + 12, y), 4, colour.filled()))?;
        root.draw(&Text::new(one.name.clone(), (x + 32, y), style))?;
    }
    Ok(())
}

/// A logarithmic axis, labelled at 1, 2 and 5 times powers of ten.
struct LogAxis {
    range: Range<f64>,
}

/// An axis from below the least to above the greatest value.
fn axis(values: impl Iterator<Item = f64>) -> LogAxis {
    let (low, high) = values.fold((f64::INFINITY, 0.0f64), |(low, high), v| (low.min(v), high.max(v)));
    LogAxis { range: if high > 0.0 { low / 1.2..high * 1.2 } else { 1.0..10.0 } }
}

impl Ranged for LogAxis {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, (from_px, to_px): (i32, i32)) -> i32 {
        let share = (value / self.range.start).ln() / (self.range.end / self.range.start).ln();
        from_px + (f64::from(to_px - from_px) * share).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        let decades = self.range.start.log10().floor() as i32..=self.range.end.log10().floor() as i32;
        let labels = decades.flat_map(|decade| [1.0, 2.0, 5.0].map(|digit| digit * 10f64.powi(decade)));
        labels.filter(|label| self.range.contains(label)).collect()
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

/// A number without exponent and without zeros at its end.
fn plain(x: f64) -> String {
    // Powers of ten may come out a little below.
    let decimals = (2.0 - (x * 1.000_1).max(1e-6).log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{x:.decimals$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_point_is_drawn_and_named_and_what_has_no_logarithm_is_left_out() {
        let series = |name: &str, scale: f64| Series {
            name: name.into(),
            points: vec![(8000.0, 0.05 * scale), (0.0, 1.0), (2000.0, 0.2 * scale), (900.0, f64::NAN)],
        };
        let all: Vec<Series> = (0..7).map(|k| series(&format!("coder {k}"), 1.0 + f64::from(k))).collect();
        let svg = rate_plot(&all, "t", "bytes a scan", "rms, mm").unwrap();
        assert_eq!(svg.matches("<circle").count(), 7 * 3);
        for text in ["coder 6", "bytes a scan", "rms, mm", "5000", "0.1"] {
            assert!(svg.lines().any(|line| line.trim() == text), "{text} is missing");
        }
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        rate_plot(&[], "", "", "").unwrap();
    }

    #[test]
    fn numbers_are_plain() {
        assert_eq!([10000.0, 0.05, 1.0, 150.0, 0.00123].map(plain), ["10000", "0.05", "1", "150", "0.00123"]);
    }
}
