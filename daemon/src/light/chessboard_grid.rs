//! From corners to grids of corners.
//!
//! Every corner looks along its four edges for the next one: the nearest whose own edge looks back, with light and dark on
//! the sides that both expect all along the line between. Two corners that choose each other are linked, and linked
//! corners take whole-numbered places in a grid. All tests are between neighbours, so perspective and lens
//! distortion bend the grid as they like (growth from neighbours as in A. Geiger, F. Moosmann, Ö. Car, B. Schuster,
//! "Automatic camera and range sensor calibration using a single shot", ICRA 2012).

use super::chessboard_corners::{Corner, CornerFinder, refine_sigma_px};
use super::field::Field;
use glam::DVec2;
use std::collections::{BTreeMap, VecDeque};
use std::f64::consts::{PI, TAU};

/// Largest angle between an edge at a corner and the line to the next corner, radians.
const MAX_TURN_RAD: f64 = 0.3;
/// Largest ratio of the contrasts of neighbours.
const MAX_CONTRAST_RATIO: f32 = 3.0;
/// Largest ratio of a link's length to the median of its corner's: a square seen at 60 degrees, and perspective.
const MAX_LENGTH_RATIO: f64 = 2.5;
/// Least contrast across the line between two corners, of the weaker corner's.
const MIN_EDGE_CONTRAST: f32 = 0.3;
/// Largest deviation of a corner from the middle of its two neighbours, of their distance: perspective and lens.
const MAX_UNEVENNESS: f64 = 0.15;

/// Corners by their places: column and row, ascending to the right and down after a turn of the picture.
#[derive(Debug, Clone, Default)]
pub(super) struct CornerGrid {
    /// Picture places of the corners, pixels.
    pub cells: BTreeMap<[i32; 2], DVec2>,
    /// Whether two corners claimed one place, or one corner two.
    pub is_torn: bool,
}

/// The corner that edge `k` of a corner leads to, and which of its edges leads back.
type Links = [Option<(usize, usize)>; 4];

impl CornerGrid {
    /// All grids of two or more linked corners, the largest first.
    pub fn find(corners: &[Corner], levels: &Field) -> Vec<Self> {
        let links: Vec<Links> = (0..corners.len()).map(|i| links_of(corners, i, levels)).collect();
        let links = alike(corners, &mutual(&links));
        let mut is_taken = vec![false; corners.len()];
        let mut grids = Vec::new();
        for seed in 0..corners.len() {
            if !is_taken[seed] && links[seed].iter().any(Option::is_some) {
                grids.push(grow(corners, &links, seed, &mut is_taken));
            }
        }
        grids.sort_by_key(|g| std::cmp::Reverse(g.cells.len()));
        grids
    }

    /// Least and largest column and row.
    fn bounds(&self) -> ([i32; 2], [i32; 2]) {
        let start = ([i32::MAX; 2], [i32::MIN; 2]);
        self.cells.keys().fold(start, |(low, high), cell| {
            ([0, 1].map(|d: usize| low[d].min(cell[d])), [0, 1].map(|d: usize| high[d].max(cell[d])))
        })
    }

    /// Columns and rows.
    pub fn size(&self) -> [u32; 2] {
        let (low, high) = self.bounds();
        [0, 1].map(|d: usize| (high[d] - low[d] + 1) as u32)
    }

    /// Whether every place within the bounds holds a corner and neighbours are evenly spaced.
    pub fn is_whole(&self) -> bool {
        let [columns, rows] = self.size();
        !self.is_torn
            && self.cells.len() == columns as usize * rows as usize
            && self.cells.iter().all(|(cell, px)| self.is_even(*cell, *px))
    }

    fn is_even(&self, cell: [i32; 2], px: DVec2) -> bool {
        [[1, 0], [0, 1]].iter().all(|step| match (self.at(cell, *step, -1), self.at(cell, *step, 1)) {
            (Some(a), Some(b)) => (0.5 * (a + b)).distance(px) <= MAX_UNEVENNESS * a.distance(b),
            _ => true,
        })
    }

    /// A corner whose line of five bends as no lens and no perspective does: the fourth difference of places is far from zero,
    /// and from what noise makes it elsewhere in the grid. Something lies over it.
    pub fn bent(&self, finder: &CornerFinder) -> Option<DVec2> {
        /// Differences that pass: in any case, pixels and of the spacing (perspective at a tilt of 50 degrees close by), and, times
        /// the contrast, of the median (seven standard deviations of noise).
        const ALWAYS_PX: f64 = 1.0;
        const OF_SPACING: f64 = 0.015;
        const OF_MEDIAN: f64 = 6.0;
        let contrast = |px: &DVec2| finder.corner_at(*px).map_or(0.0, |corner| f64::from(corner.contrast));
        let contrasts: BTreeMap<[i32; 2], f64> = self.cells.iter().map(|(cell, px)| (*cell, contrast(px))).collect();
        let mut noise: Vec<f64> = Vec::new();
        let mut large: Vec<(f64, DVec2)> = Vec::new();
        for (cell, px) in &self.cells {
            for step in [[1, 0], [0, 1]] {
                let around = [-2, -1, 1, 2].map(|n| self.at(*cell, step, n));
                if let [Some(a), Some(b), Some(c), Some(d)] = around {
                    let difference_px = (a + d - 4.0 * (b + c) + 6.0 * *px).length();
                    noise.push(difference_px * contrasts[cell]);
                    if difference_px > ALWAYS_PX + OF_SPACING * 0.5 * b.distance(c) {
                        large.push((difference_px * contrasts[cell], *px));
                    }
                }
            }
        }
        noise.sort_by(f64::total_cmp);
        let median = noise.get(noise.len() / 2)?;
        let worst = large.into_iter().max_by(|a, b| a.0.total_cmp(&b.0));
        worst.filter(|(difference, _)| *difference > OF_MEDIAN * median).map(|(_, px)| px)
    }

    fn at(&self, cell: [i32; 2], step: [i32; 2], count: i32) -> Option<DVec2> {
        self.cells.get(&[cell[0] + count * step[0], cell[1] + count * step[1]]).copied()
    }

    /// Distance to the nearest neighbour in the grid, pixels.
    pub fn spacing_px(&self, cell: [i32; 2]) -> f64 {
        let neighbours = [[1, 0], [-1, 0], [0, 1], [0, -1]];
        let distances = neighbours.iter().filter_map(|s| Some(self.at(cell, *s, 1)?.distance(self.cells[&cell])));
        distances.fold(f64::INFINITY, f64::min)
    }

    /// Takes off outermost lines that hold corners in less than a third of their places: marks on the wall that happen to
    /// continue the board.
    pub fn trim(&mut self) {
        loop {
            let (low, high) = self.bounds();
            let size = self.size();
            let lines = [0, 1].into_iter().flat_map(|d: usize| [(d, low[d]), (d, high[d])]);
            let count = |d: usize, at: i32| self.cells.keys().filter(|cell| cell[d] == at).count();
            let Some((d, at)) = lines.into_iter().find(|&(d, at)| 3 * count(d, at) < size[1 - d] as usize) else {
                return;
            };
            self.cells.retain(|cell, _| cell[d] != at);
        }
    }

    /// Looks for corners at the places inside and next to the grid that have none, as long as it stays within the wanted columns
    /// and rows, either way: noise or a scratch hides some.
    pub fn fill(&mut self, finder: &CornerFinder, wanted: [u32; 2]) {
        loop {
            let (low, high) = self.bounds();
            let mut found = Vec::new();
            for row in low[1] - 1..=high[1] + 1 {
                for column in low[0] - 1..=high[0] + 1 {
                    if let Some(px) = self.look_at([column, row], finder) {
                        found.push(([column, row], px));
                    }
                }
            }
            found.retain(|(cell, _)| self.stays_within(*cell, wanted));
            // One at a time: each changes what stays within.
            let Some((cell, px)) = found.into_iter().next() else { return };
            self.cells.insert(cell, px);
        }
    }

    fn stays_within(&self, cell: [i32; 2], wanted: [u32; 2]) -> bool {
        let (low, high) = self.bounds();
        let [a, b] = [0, 1].map(|d: usize| (high[d].max(cell[d]) - low[d].min(cell[d]) + 1) as u32);
        a.max(b) <= wanted[0].max(wanted[1]) && a.min(b) <= wanted[0].min(wanted[1])
    }

    /// The corner at an empty place, where its neighbours expect it and the edges from them lead to.
    fn look_at(&self, cell: [i32; 2], finder: &CornerFinder) -> Option<DVec2> {
        if self.cells.contains_key(&cell) {
            return None;
        }
        let mut guesses = Vec::new();
        let mut neighbours = Vec::new();
        let mut spacing_px = f64::INFINITY;
        for step in [[1, 0], [-1, 0], [0, 1], [0, -1]] {
            if let (Some(a), Some(b)) = (self.at(cell, step, 1), self.at(cell, step, 2)) {
                guesses.push(2.0 * a - b);
                neighbours.push(a);
                spacing_px = spacing_px.min(a.distance(b));
            }
        }
        if guesses.len() < 2 {
            return None;
        }
        let expected = guesses.iter().sum::<DVec2>() / guesses.len() as f64;
        let px = finder.refine(expected, refine_sigma_px(spacing_px))?;
        let corner = finder.corner_at(px)?;
        let is_linked = |a: &DVec2| finder.corner_at(*a).is_some_and(|n| link(&corner, &n, finder.levels()).is_some());
        let is_near = px.distance(expected) < 2.0 * MAX_UNEVENNESS * spacing_px;
        (is_near && neighbours.iter().all(is_linked)).then_some(px)
    }
}

/// For every edge of corner `i` the nearest corner that it can lead to.
fn links_of(corners: &[Corner], i: usize, levels: &Field) -> Links {
    let from = &corners[i];
    let ahead = |(j, to): (usize, &Corner)| {
        let line = to.px - from.px;
        let k = if j == i { None } else { edge_along(from, line) };
        k.map(|k| (line.length_squared(), j, k))
    };
    let mut order: Vec<(f64, usize, usize)> = corners.iter().enumerate().filter_map(ahead).collect();
    order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut links = [None; 4];
    for (_, j, k) in order {
        if links[k].is_none() {
            links[k] = link(from, &corners[j], levels).map(|[_, back]| (j, back));
        }
    }
    links
}

/// The edges, one of each corner, that form one line between the two.
fn link(from: &Corner, to: &Corner, levels: &Field) -> Option<[usize; 2]> {
    let (k, back) = (edge_along(from, to.px - from.px)?, edge_along(to, from.px - to.px)?);
    let ratio = to.contrast / from.contrast;
    // Seen from the other end, light is on the other side.
    let is_line = from.is_light_after(k) != to.is_light_after(back)
        && (1.0 / MAX_CONTRAST_RATIO..=MAX_CONTRAST_RATIO).contains(&ratio)
        && is_edge(from, to, from.is_light_after(k), levels);
    is_line.then_some([k, back])
}

/// Which edge of a corner runs along a direction.
fn edge_along(corner: &Corner, direction: DVec2) -> Option<usize> {
    let angle = libm::atan2(direction.y, direction.x);
    let turn = |edge: f64| ((angle - edge + PI).rem_euclid(TAU) - PI).abs();
    (0..4).find(|&k| turn(corner.edges_rad[k]) < MAX_TURN_RAD)
}

/// Whether light and dark are on their sides all along the line between two corners.
fn is_edge(from: &Corner, to: &Corner, is_light_after: bool, levels: &Field) -> bool {
    /// Distance of the samples from the line, of its length and at least, pixels: inside foreshortened squares too.
    const OFFSET: f64 = 0.2;
    const MIN_OFFSET_PX: f64 = 1.5;
    let line = to.px - from.px;
    let length = line.length();
    let side = line.perp() / length * (OFFSET * length).max(MIN_OFFSET_PX);
    let least = MIN_EDGE_CONTRAST * from.contrast.min(to.contrast);
    let sign = if is_light_after { 1.0 } else { -1.0 };
    [0.3, 0.5, 0.7].iter().all(|&t| {
        let middle = from.px + t * line;
        let difference = levels.sample((middle + side).to_array()) - levels.sample((middle - side).to_array());
        sign * difference >= least
    })
}

/// Only the links that both ends have.
fn mutual(links: &[Links]) -> Vec<Links> {
    let both = |i: usize, k: usize| links[i][k].filter(|&(j, back)| links[j][back] == Some((i, k)));
    (0..links.len()).map(|i| std::array::from_fn(|k| both(i, k))).collect()
}

/// Only the links that are no much longer than the others of both their corners: others lead across the wall.
fn alike(corners: &[Corner], links: &[Links]) -> Vec<Links> {
    let length = |i: usize, j: usize| corners[i].px.distance(corners[j].px);
    let median = |i: usize| {
        let mut lengths: Vec<f64> = links[i].iter().flatten().map(|&(j, _)| length(i, j)).collect();
        lengths.sort_by(f64::total_cmp);
        lengths.get(lengths.len() / 2).copied().unwrap_or(0.0)
    };
    let medians: Vec<f64> = (0..links.len()).map(median).collect();
    let is_alike = |i: usize, j: usize| length(i, j) <= MAX_LENGTH_RATIO * medians[i].min(medians[j]);
    let keep = |(i, of): (usize, &Links)| of.map(|link| link.filter(|&(j, _)| is_alike(i, j)));
    links.iter().enumerate().map(keep).collect()
}

/// Gives places to all corners linked with `seed`, at the origin.
fn grow(corners: &[Corner], links: &[Links], seed: usize, is_taken: &mut [bool]) -> CornerGrid {
    /// Steps of the four edges in ascending direction: x right, y down.
    const STEPS: [[i32; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];
    let mut grid = CornerGrid::default();
    // Place and the turn from a corner's own edges to those of the seed.
    let mut placed: BTreeMap<usize, ([i32; 2], usize)> = BTreeMap::from([(seed, ([0, 0], 0))]);
    grid.cells.insert([0, 0], corners[seed].px);
    is_taken[seed] = true;
    let mut queue = VecDeque::from([seed]);
    while let Some(i) = queue.pop_front() {
        let (cell, turn) = placed[&i];
        for (k, link) in links[i].iter().enumerate() {
            let Some((j, back)) = *link else { continue };
            let direction = (k + turn) % 4;
            let next = [0, 1].map(|d: usize| cell[d] + STEPS[direction][d]);
            // The edge that leads back has the opposite direction.
            let next_turn = (direction + 6 - back) % 4;
            match placed.get(&j) {
                Some(known) => grid.is_torn |= *known != (next, next_turn),
                None => {
                    placed.insert(j, (next, next_turn));
                    is_taken[j] = true;
                    grid.is_torn |= grid.cells.insert(next, corners[j].px).is_some();
                    queue.push_back(j);
                }
            }
        }
    }
    grid
}
