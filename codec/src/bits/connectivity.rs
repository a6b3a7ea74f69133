//! Connectivity of a disk in five letters a triangle: Edgebreaker (Rossignac 1999, "Edgebreaker: connectivity
//! compression for triangle meshes"), the border being the first loop.
//!
//! The decoder needs no offsets for S: reading the letters backwards gives the length of every loop.

use crate::mesh::half_edge::NONE;
use crate::mesh::{HalfEdges, TriMesh};
use crate::{CodecError, Result};

/// Letters as bytes; frozen by FORMAT.md.
const C: u8 = 0;
const L: u8 = 1;
const E: u8 = 2;
const R: u8 = 3;
const S: u8 = 4;

/// The letters of a disk and the order in which its vertices come out of the decoder.
#[derive(Debug, Clone)]
pub struct EncodedConnectivity {
    /// One letter a triangle.
    pub letters: Vec<u8>,
    /// `order[new] = old` vertex index.
    pub order: Vec<u32>,
    /// Vertices on the border; they come first.
    pub border_count: usize,
}

/// Vertices that predict a vertex: by parallelogram `a + b - opposite` where a triangle lies behind the gate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Parent {
    /// The first vertex of all.
    None,
    /// The vertex before it on the border.
    Along(u32),
    /// The middle of the gate (no triangle known behind it).
    Middle(u32, u32),
    /// Parallelogram over the gate: a, b, opposite.
    Parallelogram(u32, u32, u32),
}

/// Decoded triangles and, for each vertex, what predicts it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DecodedConnectivity {
    /// Triangles in letter order.
    pub triangles: Vec<[u32; 3]>,
    /// One a vertex; parents always have smaller indices.
    pub parents: Vec<Parent>,
}

/// Codes the connectivity of a disk.
///
/// # Errors
/// [`CodecError::Mesh`] when `mesh` is not a disk.
pub fn encode(mesh: &TriMesh) -> Result<EncodedConnectivity> {
    let he = HalfEdges::build(mesh.vertex_count(), &mesh.triangles)?;
    let loops = he.boundary_loops();
    if loops.len() != 1 || he.euler_characteristic() != 1 {
        return Err(CodecError::Mesh(format!("not a disk: {} boundary loops", loops.len())));
    }
    let mut order = loops[0].clone();
    let border_count = order.len();
    let mut touched = vec![false; mesh.vertex_count()];
    for &v in &order {
        touched[v as usize] = true;
    }
    let first = (0..he.twin.len() as u32)
        .find(|&h| he.twin[h as usize] == NONE && origin(mesh, h) == order[0])
        .ok_or_else(|| CodecError::Mesh("the border has no edge".into()))?;
    let letters = walk(mesh, &he.twin, first, &mut touched, &mut order);
    if order.len() != mesh.vertex_count() || letters.len() != mesh.triangles.len() {
        return Err(CodecError::Mesh("not in one piece".into()));
    }
    Ok(EncodedConnectivity { letters, order, border_count })
}

fn origin(mesh: &TriMesh, h: u32) -> u32 {
    mesh.triangles[h as usize / 3][h as usize % 3]
}

fn walk(mesh: &TriMesh, twins: &[u32], first: u32, touched: &mut [bool], order: &mut Vec<u32>) -> Vec<u8> {
    let mut visited = vec![false; mesh.triangles.len()];
    let mut letters = Vec::with_capacity(visited.len());
    let mut lefts = Vec::new();
    let mut gate = first;
    loop {
        visited[gate as usize / 3] = true;
        let base = gate / 3 * 3;
        let (right, left) = (base + (gate + 1) % 3, base + (gate + 2) % 3);
        let (right_gate, left_gate) = (twins[right as usize], twins[left as usize]);
        let apex = origin(mesh, left);
        let closed = |g: u32, visited: &[bool]| g == NONE || visited[g as usize / 3];
        if !std::mem::replace(&mut touched[apex as usize], true) {
            order.push(apex);
            letters.push(C);
            gate = right_gate;
            continue;
        }
        (letters.push(match (closed(left_gate, &visited), closed(right_gate, &visited)) {
            (true, true) => E,
            (false, true) => R,
            (true, false) => L,
            (false, false) => S,
        }));
        gate = match letters.last() {
            Some(&R) => left_gate,
            Some(&L) => right_gate,
            Some(&S) => {
                lefts.push(left_gate);
                right_gate
            }
            _ => match lefts.pop() {
                Some(g) => g,
                None => return letters,
            },
        };
    }
}

/// Active loops as doubly linked nodes; a node is one occurrence of a vertex and stands for the edge to its successor.
struct Loops {
    vertex: Vec<u32>,
    next: Vec<u32>,
    prev: Vec<u32>,
    /// Apex of the decoded triangle behind the edge that leaves the node.
    behind: Vec<u32>,
}

impl Loops {
    fn border(n: u32) -> Self {
        Self {
            vertex: (0..n).collect(),
            next: (0..n).map(|i| (i + 1) % n).collect(),
            prev: (0..n).map(|i| (i + n - 1) % n).collect(),
            behind: vec![NONE; n as usize],
        }
    }

    fn add(&mut self, vertex: u32) -> u32 {
        self.vertex.push(vertex);
        self.next.push(NONE);
        self.prev.push(NONE);
        self.behind.push(NONE);
        self.vertex.len() as u32 - 1
    }

    fn link(&mut self, from: u32, to: u32, behind: u32) {
        self.next[from as usize] = to;
        self.prev[to as usize] = from;
        self.behind[from as usize] = behind;
    }

    fn step(&self, mut node: u32, forward: bool, count: u32) -> u32 {
        let table = if forward { &self.next } else { &self.prev };
        for _ in 0..count {
            node = table[node as usize];
        }
        node
    }
}

/// Rebuilds triangles from letters; `border_count` and `vertex_count` come from the header.
///
/// # Errors
/// [`CodecError::Payload`] at the letter that does not fit.
pub fn decode(letters: &[u8], border_count: usize, vertex_count: usize) -> Result<DecodedConnectivity> {
    let splits = split_lengths(letters, border_count, vertex_count)?;
    let mut splits = splits.iter().rev();
    let mut loops = Loops::border(border_count as u32);
    let mut out =
        DecodedConnectivity { triangles: Vec::with_capacity(letters.len()), parents: border_parents(border_count) };
    let mut lefts = Vec::new();
    let mut gate = 0u32;
    for &letter in letters {
        let (a, b) = (gate, loops.next[gate as usize]);
        let (va, vb) = (loops.vertex[a as usize], loops.vertex[b as usize]);
        let apex;
        (apex, gate) = match letter {
            C => {
                let v = out.parents.len() as u32;
                out.parents.push(match loops.behind[a as usize] {
                    NONE => Parent::Middle(va, vb),
                    opposite => Parent::Parallelogram(va, vb, opposite),
                });
                let node = loops.add(v);
                loops.link(a, node, vb);
                loops.link(node, b, va);
                (v, node)
            }
            R => {
                let node = loops.next[b as usize];
                loops.link(a, node, vb);
                (loops.vertex[node as usize], a)
            }
            L => {
                let node = loops.prev[a as usize];
                loops.link(node, b, va);
                (loops.vertex[node as usize], node)
            }
            S => {
                let &(right, left) = splits.next().ok_or_else(|| bad(0, "a split without a loop"))?;
                let node = if right <= left { loops.step(b, true, right - 1) } else { loops.step(a, false, left - 1) };
                let v = loops.vertex[node as usize];
                let copy = loops.add(v);
                let before = loops.prev[node as usize];
                let behind = loops.behind[before as usize];
                loops.link(before, copy, behind);
                loops.link(copy, b, va);
                loops.link(a, node, vb);
                lefts.push(a);
                (v, copy)
            }
            _ => (loops.vertex[loops.next[b as usize] as usize], lefts.pop().unwrap_or(0)),
        };
        out.triangles.push([va, vb, apex]);
    }
    Ok(out)
}

fn border_parents(count: usize) -> Vec<Parent> {
    (0..count as u32).map(|v| if v == 0 { Parent::None } else { Parent::Along(v - 1) }).collect()
}

fn bad(offset: usize, reason: impl Into<String>) -> CodecError {
    CodecError::Payload { section: "connectivity", offset, reason: reason.into() }
}

/// Lengths (right, left) of the loops after each S, last S first, found by reading the letters backwards; checks
/// that the letters close every loop and that the counts fit.
fn split_lengths(letters: &[u8], border_count: usize, vertex_count: usize) -> Result<Vec<(u32, u32)>> {
    let (mut stack, mut splits): (Vec<u32>, Vec<(u32, u32)>) = (Vec::new(), Vec::new());
    let mut new_vertices = 0;
    for (i, &letter) in letters.iter().enumerate().rev() {
        match letter {
            E => stack.push(3),
            S => {
                let (Some(right), Some(left)) = (stack.pop(), stack.pop()) else {
                    return Err(bad(i, "a split whose loops are not closed"));
                };
                splits.push((right, left));
                stack.push(right + left - 1);
            }
            C | L | R => {
                let top = stack.last_mut().ok_or_else(|| bad(i, "letters go on after the last loop closed"))?;
                if letter == C {
                    new_vertices += 1;
                    *top -= 1;
                } else {
                    *top += 1;
                }
                if *top < 3 {
                    return Err(bad(i, "a loop of fewer than three edges"));
                }
            }
            other => return Err(bad(i, format!("letter {other}, 0 to 4 are defined"))),
        }
    }
    if stack.len() != 1 || stack[0] as usize != border_count {
        return Err(bad(0, format!("the letters do not close a border of {border_count} vertices")));
    }
    if border_count + new_vertices != vertex_count {
        return Err(bad(0, format!("{} vertices, {vertex_count} announced", border_count + new_vertices)));
    }
    Ok(splits)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use glam::Vec3;
    use proptest::prelude::*;

    /// A disk grown by gluing triangles to a random border edge or closing a random border corner.
    pub(crate) fn random_disk(choices: &[u16]) -> TriMesh {
        let mut border: Vec<u32> = vec![0, 1, 2];
        let mut triangles = vec![[0, 1, 2]];
        let mut count = 3;
        let mut edges: std::collections::BTreeSet<(u32, u32)> = [(0, 1), (1, 2), (0, 2)].into();
        for &c in choices {
            let i = c as usize % border.len();
            let (a, b) = (border[i], border[(i + 1) % border.len()]);
            let d = border[(i + 2) % border.len()];
            let key = (a.min(d), a.max(d));
            if c & 0x8000 != 0 && border.len() > 3 && !edges.contains(&key) {
                // Border runs a -> b -> d with the surface on its left: fill the corner at b from outside.
                triangles.push([a, d, b]);
                edges.insert(key);
                border.remove((i + 1) % border.len());
            } else {
                triangles.push([b, a, count]);
                edges.insert((a, count));
                edges.insert((b, count));
                border.insert(i + 1, count);
                count += 1;
            }
        }
        let positions_mm =
            (0..count).map(|v| Vec3::new((v as f32).sin(), (v as f32 * 0.7).cos(), v as f32 * 0.01)).collect();
        TriMesh { positions_mm, triangles, uv: None }
    }

    fn sorted_triangles(triangles: impl Iterator<Item = [u32; 3]>) -> Vec<[u32; 3]> {
        let mut out: Vec<[u32; 3]> = triangles
            .map(|t| {
                let k = (0..3).min_by_key(|&k| t[k]).unwrap_or(0);
                [t[k], t[(k + 1) % 3], t[(k + 2) % 3]]
            })
            .collect();
        out.sort_unstable();
        out
    }

    proptest! {
        #[test]
        fn round_trip(choices in prop::collection::vec(any::<u16>(), 1..400)) {
            let mesh = random_disk(&choices);
            let coded = encode(&mesh).unwrap();
            let decoded = decode(&coded.letters, coded.border_count, mesh.vertex_count()).unwrap();
            let back = decoded.triangles.iter().map(|t| t.map(|v| coded.order[v as usize]));
            prop_assert_eq!(sorted_triangles(back), sorted_triangles(mesh.triangles.iter().copied()));
            for (v, p) in decoded.parents.iter().enumerate() {
                let below = |x: u32| (x as usize) < v;
                let earlier = match *p {
                    Parent::None => v == 0,
                    Parent::Along(a) => below(a),
                    Parent::Middle(a, b) => below(a) && below(b),
                    Parent::Parallelogram(a, b, c) => below(a) && below(b) && below(c),
                };
                prop_assert!(earlier);
            }
        }

        #[test]
        fn any_letters_give_an_error_or_a_mesh(
            letters in prop::collection::vec(0u8..6, 0..60), border in 0usize..20, vertices in 0usize..40,
        ) {
            if let Ok(d) = decode(&letters, border, vertices) {
                prop_assert_eq!(d.triangles.len(), letters.len());
                prop_assert!(d.triangles.iter().flatten().all(|&v| (v as usize) < vertices));
            }
        }
    }

    /// Letters of a chain of `splits` splits; `deep` cuts the loops in halves, else one triangle a split falls off.
    fn split_letters(splits: u32, deep: bool) -> Vec<u8> {
        let mut letters = Vec::new();
        let mut open = vec![splits];
        while let Some(n) = open.pop() {
            if n == 0 {
                letters.push(E);
                continue;
            }
            letters.push(S);
            // Pushed left first: the right loop comes first in the letters.
            open.extend(if deep { [(n - 1) / 2, n - 1 - (n - 1) / 2] } else { [0, n - 1] });
        }
        letters
    }

    /// Edges of the loop that letters close, as the decoder finds them.
    fn border_of(letters: &[u8]) -> usize {
        let count = |l: u8| letters.iter().filter(|&&x| x == l).count();
        2 * count(E) + 1 + count(L) + count(R) - count(C)
    }

    #[test]
    fn splits_walk_the_shorter_side() {
        for deep in [true, false] {
            let letters = split_letters(100_000, deep);
            let border = border_of(&letters);
            let steps: u64 =
                split_lengths(&letters, border, border).unwrap().iter().map(|&(r, l)| u64::from(r.min(l))).sum();
            assert!(steps < 200_000 * 18, "{steps} steps");
            let decoded = decode(&letters, border, border).unwrap();
            assert_eq!(decoded.triangles.len(), 200_001);
            assert!(HalfEdges::build(border, &decoded.triangles).unwrap().is_disk());
        }
    }

    #[test]
    fn golden_letters() {
        // A hexagon around one vertex: C opens the middle, R closes round to the last triangle.
        let ring: Vec<[u32; 3]> = (0..6).map(|k| [k, (k + 1) % 6, 6]).collect();
        let mesh = TriMesh {
            positions_mm: (0..7).map(|k| Vec3::new((k as f32).cos(), (k as f32).sin(), 0.0)).collect(),
            triangles: ring,
            uv: None,
        };
        let coded = encode(&mesh).unwrap();
        assert_eq!(coded.letters, vec![C, R, R, R, R, E]);
        assert_eq!(coded.border_count, 6);
    }
}
