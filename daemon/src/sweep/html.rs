//! A sweep as one page that needs nothing else: plots, tables and error maps.

use super::report::{Curve, SweepReport};
use std::fmt::Write;

/// What the page shows besides the figures.
pub struct Page<'a> {
    /// The figures.
    pub report: &'a SweepReport,
    /// Plots as SVG text.
    pub plots: &'a [String],
    /// Error maps.
    pub maps: &'a [ErrorMapFile],
}

/// Where errors are: coder, setting, PNG file.
pub type ErrorMapFile = (String, String, Vec<u8>);

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;color:#28292e;max-width:1080px;margin:2em auto;padding:0 1em}\
table{border-collapse:collapse;margin:1em 0;font-variant-numeric:tabular-nums}td,th{padding:.25em .7em;text-align:right;\
border-bottom:1px solid #e2e3e7}td:first-child,th:first-child,td.text{text-align:left}svg,img{max-width:100%;height:auto}\
h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}.less{color:#00734f}.more{color:#b04a00}summary{cursor:pointer}";

/// The page as HTML text.
pub fn html(page: &Page<'_>) -> String {
    let r = page.report;
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>gv3 sweep: {0}</title>\
         <style>{STYLE}</style></head><body>\n<h1>Rate and distortion: {0}</h1>\n<p>{1} scans of {2:.0} vertices on average. \
         One scan takes {3:.0} bytes as OBJ and BMP, {4:.0} as float32 and u32. Surfaces only, textures left out. Every coder's \
         result is compared with the scans that went in, every scan, by the same code.</p>\n",
        escaped(&r.input),
        r.scans,
        r.vertices_per_scan,
        r.obj_bmp_bytes_per_scan,
        r.binary_bytes_per_scan
    );
    for svg in page.plots {
        // An XML declaration has no place inside a page.
        out += svg.find("<svg").map_or("", |at| &svg[at..]);
    }
    out += "<h2>Points</h2>\n";
    points_table(&mut out, r);
    bd_table(&mut out, r);
    out += "<h2>Coders</h2>\n<ul>\n";
    for c in &r.curves {
        let missing = c.unavailable.as_ref().map_or(String::new(), |why| format!(" <b>Not run:</b> {}", escaped(why)));
        // Writing to a String cannot fail.
        let _ = writeln!(out, "<li><b>{}</b>: {}.{missing}</li>", escaped(&c.coder), escaped(&c.about));
    }
    out += "</ul>\n<h2>Where the errors are</h2>\n<p>Distance of every scan's vertices from what was decoded, gathered over \
            all scans in a front view; each map has its own scale. The other settings' maps are files beside this page.</p>\n";
    for (coder, setting, png) in page.maps {
        let title = format!("{} {}", escaped(coder), escaped(setting));
        let _ = writeln!(
            out,
            "<details><summary>{title}</summary><img alt=\"errors of {title}\" src=\"data:image/png;base64,{}\"></details>",
            base64(png)
        );
    }
    out + "</body></html>\n"
}

fn points_table(out: &mut String, r: &SweepReport) {
    *out += "<table><tr><th>coder</th><th>setting</th><th>bytes a scan</th><th>% of OBJ+BMP</th><th>rms, mm</th>\
             <th>p95</th><th>p99</th><th>max</th><th>D1, dB</th><th>D2, dB</th><th>normals, &deg;</th><th>missing, %</th>\
             <th>invented, %</th><th>encode, ms</th><th>decode, ms</th></tr>\n";
    for (c, p) in r.curves.iter().flat_map(|c| c.points.iter().map(move |p| (c, p))) {
        let (there, back) = (p.distortion.surface_mm.scan_to_replay.all, p.distortion.surface_mm.replay_to_scan.all);
        let optional = |x: Option<f64>| x.map_or("&ndash;".to_owned(), |x| format!("{x:.1}"));
        let _ = writeln!(
            out,
            "<tr><td>{}</td><td class=\"text\">{}</td><td>{:.0}</td><td>{:.4}</td><td>{:.4}</td><td>{:.3}</td><td>{:.3}</td>\
             <td>{:.2}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.3}</td><td>{:.3}</td><td>{:.1}</td><td>{:.1}</td></tr>",
            escaped(&c.coder),
            escaped(&p.setting),
            p.bytes_per_scan,
            100.0 * p.bytes_per_scan / r.obj_bmp_bytes_per_scan.max(1.0),
            p.rms_mm,
            there.p95.max(back.p95),
            there.p99.max(back.p99),
            p.max_mm,
            optional(p.distortion.d1_psnr_db),
            optional(p.distortion.d2_psnr_db),
            optional(p.distortion.normal_rms_deg),
            100.0 * p.distortion.coverage.missing,
            100.0 * p.distortion.coverage.invented,
            p.encode_ms_per_scan,
            p.decode_ms_per_scan
        );
    }
    *out += "</table>\n<p>Percentiles and maximum are those of the worse direction.</p>\n";
}

/// Rows: what is compared; columns: with what.
fn bd_table(out: &mut String, r: &SweepReport) {
    let measured: Vec<&Curve> = r.curves.iter().filter(|c| c.points.len() > 1).collect();
    if r.bd_rates.is_empty() {
        return;
    }
    *out += "<h2>Bytes at the same D1 PSNR</h2>\n<p>Bjontegaard difference (piecewise cubic) of the row against the column, \
             over the qualities both reach; negative: the row takes less.</p>\n<table><tr><th></th>";
    measured.iter().for_each(|c| *out += &format!("<th>{}</th>", escaped(&c.coder)));
    *out += "</tr>\n";
    for test in &measured {
        *out += &format!("<tr><td>{}</td>", escaped(&test.coder));
        for anchor in &measured {
            let found = r.bd_rates.iter().find(|b| b.test == test.coder && b.anchor == anchor.coder);
            let cell = found.map_or("<td>&ndash;</td>".to_owned(), |b| {
                let percent = b.difference.percent;
                let class = if percent < 0.0 { "less" } else { "more" };
                format!(
                    "<td class=\"{class}\" title=\"{:.1} to {:.1} dB\">{percent:+.1} %</td>",
                    b.difference.from_db, b.difference.to_db
                )
            });
            *out += &cell;
        }
        *out += "</tr>\n";
    }
    *out += "</table>\n";
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// RFC 4648, section 4.
fn base64(bytes: &[u8]) -> String {
    const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let bits = (0..3).fold(0u32, |bits, k| bits << 8 | u32::from(chunk.get(k).copied().unwrap_or(0)));
        for k in 0..4 {
            let letter = LETTERS[(bits >> (18 - 6 * k)) as usize & 63];
            text.push(if k > chunk.len() { '=' } else { char::from(letter) });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::report::tests::made_up;
    use super::*;

    #[test]
    fn base64_of_the_rfc() {
        for (text, code) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(text.as_bytes()), code);
        }
    }

    #[test]
    fn the_page_is_whole_and_names_everything() {
        let report = made_up();
        let plots = ["<?xml version=\"1.0\"?><svg width=\"3\"></svg>".to_owned()];
        let maps = [("one".to_owned(), "q0.1".to_owned(), vec![1, 2, 3])];
        let text = html(&Page { report: &report, plots: &plots, maps: &maps });
        for word in ["<svg width", "base64,AQID", "one &lt; made up", "tool missing", "-50.0 %", "+100.0 %", "q0.05"] {
            assert!(text.contains(word), "{word}");
        }
        assert!(!text.contains("<?xml") && !text.contains("http"), "nothing from elsewhere");
        for tag in ["table", "tr", "td", "th", "details", "ul", "li", "p", "h2", "svg", "body", "html"] {
            let opened = text.matches(&format!("<{tag}>")).count() + text.matches(&format!("<{tag} ")).count();
            assert_eq!(opened, text.matches(&format!("</{tag}>")).count(), "{tag}");
        }
    }
}
