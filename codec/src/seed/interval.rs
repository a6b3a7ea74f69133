//! From one keyframe to the next: the earlier keyframe's mesh carried through the knots around, moved by the spline,
//! with both textures on it.

use super::flattened::{Flattened, Neighbours};
use crate::mesh::HalfEdges;
use crate::motion::PixelMap;
use crate::motion::spline::NaturalSpline;
use crate::param::matching::DiskMatch;
use crate::{GreyPicture, Result, Scan};
use glam::{DVec2, Vec2, Vec3};

/// A window of keyframes and the place of the interval in it.
pub struct Window<'a> {
    /// Keyframes in time order.
    pub keyframes: &'a [&'a Flattened],
    /// Matchings of `keyframes[i]` and `keyframes[i + 1]`.
    pub matches: &'a [&'a Neighbours],
    /// Keyframe whose mesh is played.
    pub at: usize,
}

/// The scans from one keyframe up to the next.
pub struct Interval {
    base: Scan,
    spline: NaturalSpline,
    /// Positions of the mesh's vertices at every knot, mm.
    paths_mm: Vec<Vec<Vec3>>,
    /// Texture of the next keyframe brought into this one's picture, and how much later it was taken, seconds.
    next_texture: Option<(GreyPicture, f64)>,
}

/// The mesh of the interval as it lies on some keyframe: positions, texture pixels, and what has no counterpart there.
struct Carried {
    disk: Vec<DVec2>,
    positions_mm: Vec<Vec3>,
    texture_px: Vec<Vec2>,
    lost: Vec<bool>,
}

impl Interval {
    /// Carries the mesh of `keyframes[at]` to every keyframe of the window.
    ///
    /// # Errors
    /// [`crate::CodecError::Mesh`] for surfaces without usable topology.
    ///
    /// # Panics
    /// When the window is empty or `at` lies outside it.
    pub fn new(window: &Window<'_>) -> Result<Self> {
        let base = window.keyframes[window.at];
        let edges = HalfEdges::build(base.group.mesh.vertex_count(), &base.group.mesh.triangles)?;
        let start = Carried::start(base);
        let mut paths_mm = vec![start.positions_mm.clone(); window.keyframes.len()];
        let forward = (window.at + 1..window.keyframes.len()).map(|k| (k, &window.matches[k - 1].forward));
        let next_px = carry_along(window, &start, forward, &edges, &mut paths_mm);
        let backward = (0..window.at).rev().map(|k| (k, &window.matches[k].backward));
        carry_along(window, &start, backward, &edges, &mut paths_mm);
        let stamp = base.group.key();
        let seconds = |f: &Flattened| seconds_since(stamp.time_nanos, f.group.key().time_nanos);
        let knots: Vec<f64> = window.keyframes.iter().map(|f| seconds(f)).collect();
        let next = window.keyframes.get(window.at + 1).zip(next_px);
        let next_texture = match next.and_then(|(f, px)| Some((f, f.texture.as_ref()?, px))) {
            Some((f, texture, px)) => warp_texture(base, texture, &px)?.map(|t| (t, seconds(f))),
            None => None,
        };
        let base = Scan {
            tick: stamp.tick,
            time_nanos: stamp.time_nanos,
            mesh: base.group.mesh.clone(),
            texture: base.texture.clone(),
        };
        Ok(Self { base, spline: NaturalSpline::new(&knots), paths_mm, next_texture })
    }

    /// The scan at a time; the tick is the caller's to set.
    pub fn scan_at(&self, time_nanos: u64) -> Scan {
        let t = seconds_since(self.base.time_nanos, time_nanos);
        let mut scan = Scan { time_nanos, ..self.base.clone() };
        let weights = self.spline.weights(t);
        scan.mesh.positions_mm.fill(Vec3::ZERO);
        for (path, &w) in self.paths_mm.iter().zip(&weights).filter(|(_, w)| w.abs() > 1e-9) {
            for (p, &x) in scan.mesh.positions_mm.iter_mut().zip(path) {
                *p += x * w as f32;
            }
        }
        if let (Some(texture), Some((next, later_s))) = (&mut scan.texture, &self.next_texture) {
            blend(texture, next, (t / later_s).clamp(0.0, 1.0));
        }
        scan
    }
}

/// Carries the mesh from keyframe to keyframe and notes its positions on each; returns where its vertices lie in the
/// texture of the first one.
fn carry_along<'a>(
    window: &Window<'_>,
    start: &Carried,
    steps: impl Iterator<Item = (usize, &'a DiskMatch)>,
    edges: &HalfEdges,
    paths_mm: &mut [Vec<Vec3>],
) -> Option<Vec<Vec2>> {
    let mut first_px = None;
    let mut here: Option<Carried> = None;
    for (k, matching) in steps {
        let there = here.as_ref().unwrap_or(start).carry(matching, window.keyframes[k], edges);
        paths_mm[k].clone_from(&there.positions_mm);
        first_px.get_or_insert_with(|| there.texture_px.clone());
        here = Some(there);
    }
    first_px
}

fn seconds_since(origin: u64, time: u64) -> f64 {
    (time as i64 - origin as i64) as f64 * 1e-9
}

/// `a + (b - a) share`, in 256ths.
fn blend(a: &mut GreyPicture, b: &GreyPicture, share: f64) {
    let w = (share * 256.0).round() as i32;
    for (a, &b) in a.pixels.iter_mut().zip(&b.pixels) {
        *a = (i32::from(*a) + (((i32::from(b) - i32::from(*a)) * w + 128) >> 8)) as u8;
    }
}

impl Carried {
    fn start(base: &Flattened) -> Self {
        let mesh = &base.group.mesh;
        let texture_px = match (&base.texture, &mesh.uv) {
            (Some(picture), Some(uv)) => uv.iter().map(|&t| Vec2::from(picture.uv_to_px(t))).collect(),
            _ => vec![Vec2::ZERO; mesh.vertex_count()],
        };
        Self {
            disk: base.disk.points.clone(),
            positions_mm: mesh.positions_mm.clone(),
            texture_px,
            lost: vec![false; mesh.vertex_count()],
        }
    }

    /// The mesh on the next keyframe over. A vertex that falls outside its disk has no counterpart there (the border of
    /// a scan is no material line): it keeps the displacement of the nearest vertex that has one.
    fn carry(&self, matching: &DiskMatch, to: &Flattened, edges: &HalfEdges) -> Self {
        let n = self.disk.len();
        let mesh = &to.group.mesh;
        let to_px: Option<Vec<Vec2>> = match (&to.texture, &mesh.uv) {
            (Some(picture), Some(uv)) => Some(uv.iter().map(|&t| Vec2::from(picture.uv_to_px(t))).collect()),
            _ => None,
        };
        let mut out = Self {
            disk: Vec::with_capacity(n),
            positions_mm: Vec::with_capacity(n),
            texture_px: self.texture_px.clone(),
            lost: self.lost.clone(),
        };
        for (v, z) in matching.images(&self.disk).into_iter().enumerate() {
            out.lost[v] |= z.length_squared() > 1.0;
            let place = to.locate(z);
            out.lost[v] |= place.is_none();
            out.disk.push(if z.length_squared() > 1.0 { z.normalize() } else { z });
            let Some(place) = place else {
                out.positions_mm.push(self.positions_mm[v]);
                continue;
            };
            out.positions_mm.push(place.interpolate(&mesh.triangles, &mesh.positions_mm));
            if let Some(px) = &to_px {
                out.texture_px[v] = place.interpolate(&mesh.triangles, px);
            }
        }
        out.fill_lost(self, edges);
        out
    }

    /// Breadth-first from the vertices that were found: each lost one takes the displacement of its finder.
    fn fill_lost(&mut self, before: &Self, edges: &HalfEdges) {
        let mut known: Vec<bool> = self.lost.iter().map(|l| !l).collect();
        let mut queue: Vec<u32> = (0..known.len() as u32)
            .filter(|&v| known[v as usize] && edges.neighbours(v).any(|w| self.lost[w as usize]))
            .collect();
        let mut head = 0;
        while head < queue.len() {
            let v = queue[head] as usize;
            head += 1;
            let moved = self.positions_mm[v] - before.positions_mm[v];
            let moved_px = self.texture_px[v] - before.texture_px[v];
            for w in edges.neighbours(v as u32) {
                let w = w as usize;
                if !std::mem::replace(&mut known[w], true) {
                    self.positions_mm[w] = before.positions_mm[w] + moved;
                    self.texture_px[w] = before.texture_px[w] + moved_px;
                    queue.push(w as u32);
                }
            }
        }
    }
}

/// Brings the next keyframe's texture into the picture of `base`: `px` says where each vertex lies in it.
fn warp_texture(base: &Flattened, next: &GreyPicture, px: &[Vec2]) -> Result<Option<GreyPicture>> {
    let (Some(own), Some(_)) = (&base.texture, &base.group.mesh.uv) else { return Ok(None) };
    let map = PixelMap::new(&base.group.mesh, own.width_px, own.height_px)?;
    let mut out = own.clone();
    for (i, level) in out.pixels.iter_mut().enumerate() {
        let at = [(i as u32 % own.width_px) as f32, (i as u32 / own.width_px) as f32];
        if map.triangles()[i] == u32::MAX {
            continue;
        }
        if let Some(place) = map.lift(at) {
            let source: Vec2 = place.interpolate(&base.group.mesh.triangles, px);
            *level = next.sample(source.to_array()).round() as u8;
        }
    }
    Ok(Some(out))
}
