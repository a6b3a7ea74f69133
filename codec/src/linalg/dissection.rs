//! Elimination order by geometric nested dissection (George 1973): the rows of a mesh's matrix are halved at the median
//! of their places, the halves eliminated first, the rows of one half that touch the other last.
//!
//! On surfaces the fill is that of minimum degree or a little less, and the order takes a fraction of the time.

use super::LowerCsc;
use glam::Vec3;

/// Parts of this many rows are not divided further.
const LEAF_ROWS: usize = 32;

/// Rows in the order in which they are to be eliminated. `places` says where each row lies; any will do, near ones for
/// connected rows give little fill.
///
/// # Panics
/// When there is not one place a row.
pub(super) fn nested_dissection(matrix: &LowerCsc, places: &[Vec3]) -> Vec<u32> {
    assert_eq!(places.len(), matrix.size(), "one place a row");
    let (start, neighbours) = adjacency(matrix);
    // Rows go about with their places, or every comparison would fetch two from afar.
    let mut order: Vec<(u32, Vec3)> = (0..matrix.size() as u32).zip(places.iter().copied()).collect();
    let mut part_of = vec![0u32; order.len()];
    let mut parts = vec![(0, order.len())];
    let mut stamp = 0;
    while let Some((first, end)) = parts.pop() {
        if end - first <= LEAF_ROWS {
            continue;
        }
        let rows = &mut order[first..end];
        let axis = longest_axis(rows);
        let middle = rows.len() / 2;
        rows.select_nth_unstable_by(middle, |a, b| a.1[axis].total_cmp(&b.1[axis]));
        stamp += 1;
        rows[middle..].iter().for_each(|&(r, _)| part_of[r as usize] = stamp);
        let touches = |r: u32| {
            let range = start[r as usize] as usize..start[r as usize + 1] as usize;
            neighbours[range].iter().any(|&n| part_of[n as usize] == stamp)
        };
        let mut inner = 0;
        for i in 0..middle {
            if !touches(rows[i].0) {
                rows.swap(i, inner);
                inner += 1;
            }
        }
        rows[inner..].rotate_left(middle - inner);
        parts.push((first, first + inner));
        parts.push((first + inner, end - (middle - inner)));
    }
    order.into_iter().map(|(row, _)| row).collect()
}

fn longest_axis(rows: &[(u32, Vec3)]) -> usize {
    let (low, high) = (rows.iter())
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &(_, place)| (low.min(place), high.max(place)));
    (high - low).max_position()
}

/// Rows that share an entry with each row, in compressed lists.
fn adjacency(matrix: &LowerCsc) -> (Vec<u32>, Vec<u32>) {
    let n = matrix.size();
    let off_diagonal = || matrix.entries().filter(|(r, c, _)| r != c);
    let mut start = vec![0u32; n + 1];
    for (r, c, _) in off_diagonal() {
        start[r as usize + 1] += 1;
        start[c as usize + 1] += 1;
    }
    for i in 0..n {
        start[i + 1] += start[i];
    }
    let (mut fill, mut neighbours) = (start.clone(), vec![0u32; start[n] as usize]);
    for (r, c, _) in off_diagonal() {
        for (from, to) in [(r, c), (c, r)] {
            let slot = &mut fill[from as usize];
            neighbours[*slot as usize] = to;
            *slot += 1;
        }
    }
    (start, neighbours)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(side: u32) -> (LowerCsc, Vec<Vec3>) {
        let at = |x: u32, y: u32| y * side + x;
        let cells = || (0..side * side).map(|i| (i % side, i / side));
        let right = cells().filter(|(x, _)| x + 1 < side).map(|(x, y)| (at(x, y), at(x + 1, y), -1.0));
        let down = cells().filter(|(_, y)| y + 1 < side).map(|(x, y)| (at(x, y), at(x, y + 1), -1.0));
        let entries: Vec<_> = right.chain(down).collect();
        let places = cells().map(|(x, y)| Vec3::new(x as f32, y as f32, 0.0)).collect();
        (LowerCsc::assemble(&vec![4.1; (side * side) as usize], &entries), places)
    }

    #[test]
    fn it_is_a_permutation_and_the_last_rows_separate_the_others() {
        let side = 24;
        let (matrix, places) = grid(side);
        let order = nested_dissection(&matrix, &places);
        let mut sorted = order.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().copied().eq(0..side * side));
        // The first cut of a square grid is one of its middle lines.
        let last = &order[order.len() - side as usize..];
        assert!(last.iter().all(|r| r % side == 11) || last.iter().all(|r| r / side == 11), "{last:?}");
    }

    #[test]
    fn rows_in_one_place_or_nowhere_are_ordered_too() {
        let (matrix, _) = grid(12);
        for place in [Vec3::ZERO, Vec3::NAN, Vec3::INFINITY] {
            let mut order = nested_dissection(&matrix, &[place; 144]);
            order.sort_unstable();
            assert!(order.into_iter().eq(0..144));
        }
    }
}
