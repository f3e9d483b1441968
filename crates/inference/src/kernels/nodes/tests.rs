use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

/// Positions in and around the domain, some far outside or not finite.
fn positions() -> impl Strategy<Value = Vec<[f32; 2]>> {
    let coordinate = prop_oneof![
        40 => -0.1f32..2.1,
        1 => proptest::sample::select(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30][..]),
    ];
    proptest::collection::vec([coordinate.clone(), coordinate], 0..60)
}

/// The first node of a stencil, by definition.
fn base([x, y]: [f32; 2], window: &Window, width: f32) -> [i32; 2] {
    let axis = |x: f32, axis: usize| {
        let (lower, upper) = (window.lower[axis], window.upper[axis]);
        let cells = if x.is_nan() || x < lower { 0.0 } else { (x.min(upper) - lower) / width };
        (cells - 0.5).floor() as i32
    };
    [axis(x, 0), axis(y, 1)]
}

/// Every node of a window at each level, from sets of cells.
fn expected(
    position: &[[f32; 2]],
    window: &Window,
    width: f32,
    count: usize,
) -> Vec<Vec<[i32; 2]>> {
    let mut levels = vec![BTreeSet::new(); count];
    for &x in &position[window.particles.clone()] {
        let [a, b] = base(x, window, width);
        levels[0].extend((0..9).map(|k| (b + k / 3, a + k % 3)));
    }
    for level in 1..count {
        levels[level] =
            levels[level - 1].iter().map(|&(b, a)| (b.div_euclid(2), a.div_euclid(2))).collect();
    }
    levels.into_iter().map(|nodes| nodes.into_iter().map(|(b, a)| [a, b]).collect()).collect()
}

fn windows(rows: usize, cuts: [usize; 2]) -> Vec<Window> {
    let mut cuts = cuts.map(|cut| cut.min(rows));
    cuts.sort_unstable();
    let ends = [0, cuts[0], cuts[1], rows];
    let domain = |n: usize| ([0.1 * n as f32, -0.05], [1.0 + 0.3 * n as f32, 0.7 + n as f32 / 2.0]);
    let window = |n: usize| {
        let (lower, upper) = domain(n);
        Window { particles: ends[n]..ends[n + 1], lower, upper }
    };
    (0..3).map(window).collect()
}

proptest! {
    #[test]
    fn tables_equal_those_from_sets_of_cells(
        first in positions(),
        second in positions(),
        cuts: [u8; 2],
        width in 0.03f32..0.2,
        levels in [MIN_LEVELS..=MAX_LEVELS, MIN_LEVELS..=MAX_LEVELS],
    ) {
        let mut nodes = Nodes::default();
        // The second grid reuses the memory of the first.
        for (round, position) in [first, second].into_iter().enumerate() {
            let windows = windows(position.len(), cuts.map(|cut| usize::from(cut) % 61));
            nodes.rebuild(&position, &windows, width * (round + 1) as f32, levels[round]);
            check(&nodes, &position, &windows, levels[round])?;
        }
    }

    #[test]
    fn a_window_has_the_same_tables_alone_and_among_others(position in positions()) {
        let window = |rows| Window { particles: rows, lower: [0.0; 2], upper: [2.0, 1.5] };
        let (mut alone, mut two) = (Nodes::default(), Nodes::default());
        let windows = [window(0..position.len()), window(position.len()..position.len())];
        alone.rebuild(&position, &windows[..1], 0.1, 3);
        two.rebuild(&position, &windows, 0.1, 3);
        prop_assert_eq!(&alone.tables, &two.tables);
        prop_assert_eq!(&alone.windows[0], &two.windows[0]);
    }
}

#[expect(clippy::too_many_lines, reason = "one property after another of the same nodes")]
fn check(
    nodes: &Nodes,
    position: &[[f32; 2]],
    windows: &[Window],
    levels: usize,
) -> Result<(), TestCaseError> {
    let width = nodes.width();
    let mut slots = 0;
    for (window, place) in windows.iter().zip(nodes.windows()) {
        prop_assert_eq!(&place.particles, &window.particles);
        let expected = expected(position, window, width, levels);
        let row = |level: usize, at: [i32; 2]| {
            let found = expected[level].iter().position(|&other| other == at);
            found.map_or(MISSING, |n| (place.nodes[level].start + n) as u32)
        };
        prop_assert!((levels..MAX_LEVELS).all(|level| nodes.level(level).is_empty()));
        for (number, at) in expected.iter().enumerate() {
            let (level, range) = (nodes.level(number), place.nodes[number].clone());
            prop_assert_eq!(&level.at[range.clone()], at.as_slice());
            for (node, &[a, b]) in range.zip(at) {
                let near: Vec<_> =
                    (0..9).map(|k| row(number, [a + k % 3 - 1, b + k / 3 - 1])).collect();
                prop_assert_eq!(level.neighbours[node].as_slice(), near);
                if number > 0 {
                    let below: Vec<_> =
                        (0..4).map(|k| row(number - 1, [2 * a + k % 2, 2 * b + k / 2])).collect();
                    prop_assert_eq!(level.children[node].as_slice(), below);
                }
                if number + 1 < levels {
                    let children = nodes.level(number + 1).children.as_flattened();
                    prop_assert_eq!(children[level.parent[node] as usize], node as u32);
                }
            }
        }

        // Particles in the order of their cells, those of a cell in the order of their rows.
        let key = |p: usize| {
            let [a, b] = base(position[p], window, width);
            (b, a, p)
        };
        let mut sorted: Vec<_> = window.particles.clone().collect();
        sorted.sort_by_key(|&p| key(p));
        let order: Vec<_> =
            nodes.order()[window.particles.clone()].iter().map(|&p| p as usize).collect();
        prop_assert_eq!(order, sorted);
        for cell in &nodes.cells()[place.cells.clone()] {
            prop_assert_eq!(cell.slots().start, slots);
            slots = cell.slots().end;
            for slot in cell.slots() {
                let particle = nodes.order()[slot] as usize;
                let [a, b] = base(position[particle], window, width);
                let stencil = [0, 1, 2].map(|row| nodes.level(0).at[cell.nodes[row] as usize]);
                prop_assert_eq!(stencil, [[a, b], [a, b + 1], [a, b + 2]]);
                for axis in nodes.weights()[slot] {
                    prop_assert!((axis.iter().sum::<f32>() - 1.0).abs() < 1e-6);
                    prop_assert!(axis.iter().all(|&weight| weight >= -1e-6), "{axis:?}");
                }
            }
        }
        // Rows of nodes and the cells whose stencils they are in.
        for row in &nodes.rows()[place.rows.clone()] {
            let b = nodes.level(0).at[row.nodes[0] as usize][1];
            prop_assert!(nodes.level(0).at[range(row.nodes)].iter().all(|at| at[1] == b));
            for (number, &cells) in row.cells.iter().enumerate() {
                let found: Vec<_> = range(cells).collect();
                let expected: Vec<_> = (place.cells.clone())
                    .filter(|&cell| {
                        range(row.nodes).contains(&(nodes.cells()[cell].nodes[number] as usize))
                    })
                    .collect();
                prop_assert_eq!(found, expected);
            }
        }
    }
    prop_assert_eq!(slots, position.len());
    Ok(())
}

#[test]
fn weights_follow_the_particle() {
    let mut nodes = Nodes::default();
    let window = Window { particles: 0..1, lower: [-1.0, 2.0], upper: [1.0, 3.0] };
    nodes.rebuild(&[[-0.33, 2.71]], &[window], 0.1, 3);
    let [a, b] = nodes.level(0).at[nodes.cells()[0].nodes[0] as usize];
    let mean = nodes.weights()[0].map(|[_, middle, last]| middle + 2.0 * last);
    assert!((a as f32 + mean[0] - 6.7).abs() < 1e-5, "{a} {mean:?}");
    assert!((b as f32 + mean[1] - 7.1).abs() < 1e-5, "{b} {mean:?}");
}
