//! Plays a run of shots at any time: fetches the groups around it, keeps what the next call will need.

use super::as_scan::{as_scan, as_scan_at};
use super::bisection::Connectivity;
use super::change::{Change, OnDisk};
use super::group::{MAX_CONTINUED, Parts, Start, Wanted};
use super::link::Link;
use super::steps::Steps;
use super::textures::Pictures;
use super::tracked::{Shown, positions_at};
use crate::mesh::TriMesh;
use crate::player::{Fetch, Output, Payloads};
use crate::{CodecError, GreyPicture, Result, Scan, StreamHeader};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Groups whose chains are kept.
const KEPT_CHAINS: usize = 12;
/// Groups whose scans are kept: those before, at and after a moment.
const KEPT_GROUPS: usize = 3;

/// Decoder of one run.
pub struct Player {
    header: StreamHeader,
    steps: Steps,
    output: Output,
    key_times_nanos: Vec<u64>,
    chains: BTreeMap<usize, Link>,
    groups: BTreeMap<usize, Vec<Shown>>,
    /// Connectivity that the tracked mesh of a shot keeps, by the group in which it began.
    displayed: Option<(usize, Arc<Connectivity>)>,
    change: Option<(u64, Change)>,
    /// Texture of the tracked mesh, by the group in which its shot began and the tick of its keyframe.
    texture: Option<((usize, u64), KeyTexture)>,
}

/// Where a keyframe's picture shows grid nodes, and the picture.
type KeyTexture = (Vec<[f32; 2]>, GreyPicture);

/// What is shown: a surface and its texture.
type Surface = (TriMesh, Option<GreyPicture>);

type Failure<E> = std::result::Result<(), E>;

impl Player {
    /// A player of the groups whose keyframes have these times (increasing).
    ///
    /// # Errors
    /// [`CodecError::Stream`] without keyframes, when times do not increase, or for another mode's header.
    pub fn new(header: StreamHeader, key_times_nanos: Vec<u64>, output: Output) -> Result<Self> {
        if key_times_nanos.is_empty() || key_times_nanos.windows(2).any(|w| w[0] >= w[1]) {
            return Err(CodecError::Stream("a run needs keyframes whose times increase".into()));
        }
        let steps = header.steps()?;
        let (chains, groups) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self {
            header,
            steps,
            output,
            key_times_nanos,
            chains,
            groups,
            displayed: None,
            change: None,
            texture: None,
        })
    }

    /// The scan at a time, held at the ends of the run. `fetch` gives the payloads (group, texture) of a group by index.
    ///
    /// # Errors
    /// What `fetch` returns, and the codec's own errors for payloads that do not fit.
    pub fn scan_at<E: From<CodecError>>(
        &mut self,
        time_nanos: u64,
        fetch: Fetch<'_, E>,
    ) -> std::result::Result<Scan, E> {
        let last = self.key_times_nanos.len() - 1;
        let at = self.key_times_nanos.partition_point(|&t| t < time_nanos).min(last);
        let around = self.around(at, time_nanos, fetch)?;
        let period = self.header.scan_period_nanos;
        let (mesh, texture) = match self.output {
            Output::Scan => show_scan(&around, time_nanos).map_err(E::from)?,
            Output::Mesh => self.show_mesh(&around, time_nanos, fetch)?,
        };
        Ok(Scan { tick: (time_nanos + period / 2) / period, time_nanos, mesh, texture })
    }

    /// Scans in time order with `at` the index of the last one not after the moment: two on either side of it, as far as
    /// there are any.
    fn around<E: From<CodecError>>(
        &mut self,
        at: usize,
        time_nanos: u64,
        fetch: Fetch<'_, E>,
    ) -> std::result::Result<Around, E> {
        self.load(at, Wanted::Places, fetch)?;
        let mut shown: Vec<Shown> = self.groups[&at].clone();
        let mut first = at;
        if !shown.iter().any(|s| s.stamp.time_nanos == time_nanos) {
            // A neighbour is needed on both sides for the tangents.
            let index = shown.partition_point(|s| s.stamp.time_nanos <= time_nanos);
            if index < 2 && at > 0 {
                self.load(at - 1, Wanted::Places, fetch)?;
                shown.splice(0..0, self.groups[&(at - 1)].iter().cloned());
                first = at - 1;
            }
            if index + 1 >= self.groups[&at].len() && at + 1 < self.key_times_nanos.len() {
                self.load(at + 1, Wanted::Places, fetch)?;
                shown.extend(self.groups[&(at + 1)].iter().cloned());
            }
        }
        let index = shown.partition_point(|s| s.stamp.time_nanos <= time_nanos).max(1) - 1;
        if self.output == Output::Scan {
            let nearest = nearest(&shown, index, time_nanos);
            let (mut group, mut within) = (first, nearest);
            while within >= self.groups[&group].len() {
                within -= self.groups[&group].len();
                group += 1;
            }
            self.load(group, Wanted::UpTo(shown[nearest].stamp.tick), fetch)?;
            shown[nearest] = self.groups[&group][within].clone();
        }
        let from = index.saturating_sub(1);
        let to = (index + 3).min(shown.len());
        Ok(Around { shown: shown[from..to].to_vec(), at: index - from })
    }

    /// How much of a group is decoded when `wanted` of it is asked for: all of it when play goes on from a group beside it.
    fn worth(&self, group: usize, wanted: Wanted) -> Wanted {
        let is_whole = |g: usize| self.groups.get(&g).is_some_and(|shown| shown.iter().all(|s| s.scan.is_some()));
        let is_begun =
            self.groups.get(&group).is_some_and(|shown| shown.iter().rev().skip(1).any(|s| s.scan.is_some()));
        let goes_on = is_begun || is_whole(group + 1) || group.checked_sub(1).is_some_and(is_whole);
        if matches!(wanted, Wanted::UpTo(_)) && goes_on { Wanted::All } else { wanted }
    }

    /// Decodes what is wanted of a group if it is not there, and forgets groups far away.
    fn load<E: From<CodecError>>(&mut self, group: usize, wanted: Wanted, fetch: Fetch<'_, E>) -> Failure<E> {
        let has = |shown: &Vec<Shown>| match wanted {
            Wanted::Places => true,
            Wanted::UpTo(tick) => shown.iter().any(|s| s.stamp.tick == tick && s.scan.is_some()),
            Wanted::All => shown.iter().all(|s| s.scan.is_some()),
        };
        if self.groups.get(&group).is_some_and(has) {
            return Ok(());
        }
        let wanted = self.worth(group, wanted);
        let (bytes, texture) = fetch(group)?;
        let parts = Parts::read(&self.header, &bytes).map_err(E::from)?;
        let before = match group.checked_sub(1).filter(|_| parts.stamps.len() > 1) {
            Some(before) => {
                self.link(before, fetch)?;
                Some(self.chains[&before].clone())
            }
            None => None,
        };
        self.link(group, fetch)?;
        let pictures = pictures(texture.as_deref(), &parts).map_err(E::from)?;
        let (link, before) = (&self.chains[&group], before.as_ref());
        let shown = link.show(&parts, pictures.as_ref(), before, &self.steps, wanted).map_err(E::from)?;
        self.groups.insert(group, shown);
        forget(&mut self.groups, group, KEPT_GROUPS);
        Ok(())
    }

    /// Decodes the keyframe of a group and those that it rests on.
    fn link<E: From<CodecError>>(&mut self, group: usize, fetch: Fetch<'_, E>) -> Failure<E> {
        let mut waiting: Vec<(usize, Payloads)> = Vec::new();
        let mut at = group;
        while !self.chains.contains_key(&at) {
            if waiting.len() > MAX_CONTINUED {
                let text = format!("more than {MAX_CONTINUED} groups before group {group} without a base");
                return Err(CodecError::Stream(text).into());
            }
            let payloads = fetch(at)?;
            let start = Parts::read(&self.header, &payloads.0).map_err(E::from)?.start;
            waiting.push((at, payloads));
            if start != Start::Continues || at == 0 {
                break;
            }
            at -= 1;
        }
        for (at, (bytes, texture)) in waiting.into_iter().rev() {
            let parts = Parts::read(&self.header, &bytes).map_err(E::from)?;
            let before = at.checked_sub(1).and_then(|b| self.chains.get(&b));
            let pictures = pictures(texture.as_deref(), &parts).map_err(E::from)?;
            let link = Link::after(&parts, pictures.as_ref(), before, at, &self.steps).map_err(E::from)?;
            self.chains.insert(at, link);
        }
        forget(&mut self.chains, group, KEPT_CHAINS);
        Ok(())
    }

    /// The tracked mesh: one connectivity a shot, a morph between shots.
    fn show_mesh<E: From<CodecError>>(
        &mut self,
        around: &Around,
        time_nanos: u64,
        fetch: Fetch<'_, E>,
    ) -> std::result::Result<Surface, E> {
        let here = &around.shown[around.at];
        let next = around.shown.get(around.at + 1);
        if let Some(next) = next.filter(|n| n.shot != here.shot && time_nanos > here.stamp.time_nanos) {
            let start = here.stamp.time_nanos;
            if self.change.as_ref().is_none_or(|(t, _)| *t != start) {
                let (from, to) = (self.nodes(here.shot, fetch)?, self.nodes(next.shot, fetch)?);
                let earlier = OnDisk::new(here.positions_mm(&from), &from);
                self.change = Some((start, Change::new(&earlier, OnDisk::new(next.positions_mm(&to), &to))));
            }
            let share = (time_nanos - start) as f64 / (next.stamp.time_nanos - start) as f64;
            if let Some((_, change)) = &self.change {
                return Ok((change.at(share.min(1.0) as f32), None));
            }
        }
        let nodes = self.nodes(here.shot, fetch)?;
        let (same, at) = around.of_shot(here.shot);
        let positions_mm = positions_at(&same, at, time_nanos, &nodes);
        let (uv, texture) = self.key_texture(here, &nodes).unzip();
        Ok((TriMesh { positions_mm, triangles: nodes.triangles.clone(), uv }, texture))
    }

    /// Picture of a scan's keyframe, and where grid nodes lie in it.
    fn key_texture(&mut self, of: &Shown, nodes: &Connectivity) -> Option<KeyTexture> {
        let key = of.key.as_ref()?;
        let at = (of.shot, key.tick());
        let texture = match self.texture.take().filter(|(known, _)| *known == at) {
            Some((_, texture)) => texture,
            None => (key.uv(nodes), key.grey()),
        };
        self.texture = Some((at, texture.clone()));
        Some(texture)
    }

    /// Connectivity of the base that a shot began with.
    fn nodes<E: From<CodecError>>(
        &mut self,
        shot: usize,
        fetch: Fetch<'_, E>,
    ) -> std::result::Result<Arc<Connectivity>, E> {
        if let Some((_, nodes)) = self.displayed.as_ref().filter(|(s, _)| *s == shot) {
            return Ok(Arc::clone(nodes));
        }
        self.link(shot, fetch)?;
        let nodes = Arc::new(self.chains[&shot].chain.model.connectivity.clone());
        self.displayed = Some((shot, Arc::clone(&nodes)));
        Ok(nodes)
    }
}

fn pictures<'a>(texture: Option<&'a [u8]>, parts: &Parts<'_>) -> Result<Option<Pictures<'a>>> {
    texture.map(|t| Pictures::read(t, parts.stamps.len() - 1)).transpose()
}

/// Scans around a moment.
struct Around {
    shown: Vec<Shown>,
    /// Index of the last one not after it, or the first.
    at: usize,
}

impl Around {
    /// Those of one shot, and the index among them.
    fn of_shot(&self, shot: usize) -> (Vec<&Shown>, usize) {
        let before = self.shown[..self.at].iter().filter(|s| s.shot == shot).count();
        (self.shown.iter().filter(|s| s.shot == shot).collect(), before)
    }
}

/// Index of the scan nearest to a moment: `at`, the last one not after it, or the next.
fn nearest(shown: &[Shown], at: usize, time_nanos: u64) -> usize {
    let distance = |s: &Shown| s.stamp.time_nanos.abs_diff(time_nanos);
    let is_next = shown.get(at + 1).is_some_and(|next| distance(next) < distance(&shown[at]));
    at + usize::from(is_next)
}

/// The nearest scan as it was seen, its surface moved along to the moment.
fn show_scan(around: &Around, time_nanos: u64) -> Result<Surface> {
    let here = &around.shown[around.at];
    let nearest = &around.shown[nearest(&around.shown, around.at, time_nanos)];
    let (same, at) = around.of_shot(here.shot);
    let Some(scan) = &nearest.scan else { return Err(CodecError::Stream("the scan was not decoded".into())) };
    if nearest.stamp.time_nanos == time_nanos || nearest.shot != here.shot || same.len() < 2 {
        return Ok((as_scan(&nearest.model, scan), nearest.texture()?));
    }
    let nodes = &nearest.model.connectivity;
    let moved = positions_at(&same, at, time_nanos, nodes);
    let still = nearest.positions_mm(nodes);
    let by: Vec<_> = moved.iter().zip(&still).map(|(a, b)| *a - *b).collect();
    Ok((as_scan_at(&nearest.model, scan, &by), nearest.texture()?))
}

/// Keeps the `most` entries nearest to `around`.
fn forget<T>(map: &mut BTreeMap<usize, T>, around: usize, most: usize) {
    while map.len() > most {
        let (first, last) = (map.keys().next().copied(), map.keys().next_back().copied());
        let (Some(first), Some(last)) = (first, last) else { return };
        let far = if around.abs_diff(first) > around.abs_diff(last) { first } else { last };
        map.remove(&far);
    }
}
