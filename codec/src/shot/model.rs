//! What a shot moves: its base, decimated where flat, and the camera that sees it.

use super::base::Base;
use super::bisection::{Connectivity, bisect};
use super::frames::{Frame, frames};
use super::group::NewBase;
use super::motion::Motion;
use super::raster::DepthPicture;
use super::view::{Seen, View};

/// Pixels looked at while drawing, for each pixel of a picture and beyond that, before drawing ends: a hundred times what
/// any surface needs, and a bound on the time that a payload can take.
const DRAWN_PER_PIXEL: usize = 64;
const DRAWN_MORE: usize = 1 << 20;

/// A base ready to be moved and drawn.
#[derive(Debug, Clone)]
pub struct Model {
    /// Camera of the shot, before the offset of each scan's window.
    pub view: View,
    /// The surface on the whole domain grid.
    pub base: Base,
    /// Nodes in use and triangles.
    pub connectivity: Connectivity,
    /// Frames of the lattice nodes.
    pub frames: [Vec<Frame>; 3],
    /// Neighbouring pixels whose depths differ by more than this are not joined, units.
    pub edge_step: i32,
}

impl Model {
    /// The model of a base, decimated where it is flat within `flat` units.
    pub fn new(new: &NewBase, flat: i32) -> Self {
        let base = new.base.build();
        let connectivity = bisect(&base.positions, flat);
        let frames = frames(&base);
        Self { view: new.view, base, connectivity, frames, edge_step: new.edge_step }
    }
}

/// Pixels of a camera that a scan fills.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Window {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Where the camera's first pixel lies in the window, 1/256 px.
    pub offset: [i32; 2],
}

/// The model as one scan's camera sees it.
#[derive(Debug, Clone)]
pub struct Drawn {
    /// Where each vertex is seen.
    pub seen: Vec<Seen>,
    /// Nearest triangle and its depth a pixel.
    pub picture: DepthPicture,
}

impl Drawn {
    /// Draws a moved model.
    pub fn new(model: &Model, motion: &Motion, window: &Window) -> Self {
        let view = model.view.moved(window.offset);
        let positions = motion.positions(&model.base, &model.connectivity);
        let seen: Vec<Seen> = positions.iter().map(|p| view.project(*p).unwrap_or(Seen::NOWHERE)).collect();
        let mut picture = DepthPicture::new(window.width, window.height);
        let mut budget = DRAWN_PER_PIXEL * picture.depth.len() + DRAWN_MORE;
        for (i, t) in model.connectivity.triangles.iter().enumerate() {
            let drawn = picture.draw(i as u32, t.map(|v| seen[v as usize]));
            if drawn > budget {
                break;
            }
            budget -= drawn;
        }
        Self { seen, picture }
    }
}
