//! Bodies of jelly in free fall, under strain, in vibration, and at a wall.

use super::*;

const SPACING: f32 = 1.0 / 128.0;
const DT: f32 = 0.016;
/// 1 / the time that they take to cross 3.5 spacings (1 / s).
const RATE: f32 = 17.320_508 / (3.5 * SPACING);
/// Jelly of E = 300 without Poisson's effect, without gravity: pressure waves have a speed of sqrt(300).
const LAW: Elasticity = Elasticity {
    lame: [150.0, 0.0],
    viscosity: 0.0,
    wall_distance: 0.0,
    wall_stiffness: RATE * RATE,
    rebound: 1.0,
    clear_distance: 7.0 * SPACING,
    most_stretch: 1.25,
    most_error: 0.1,
    small_error: 0.035 * SPACING,
    steps: 24,
    dt: DT,
    gravity: [0.0, 0.0],
};
const FAR: Walls = Walls { lower: [-9.0; 2], upper: [9.0; 2] };

/// A block of `columns` x `rows` particles.
fn block(columns: usize, rows: usize) -> Vec<[f32; 2]> {
    let at = |k: usize| [(k % columns) as f32, (k / columns) as f32];
    (0..columns * rows).map(|k| at(k).map(|steps| 0.3 + steps * SPACING)).collect()
}

/// Of jelly, with elements as wide as so many spacings.
fn wide_lattices(rest: &[[f32; 2]], width: f32, law: Elasticity) -> Lattices {
    let material = vec![Material::Jelly; rest.len()];
    let shape = RestShape::new(rest, &material, 1, SPACING);
    Lattices::new((&shape, 0..rest.len()), rest, &material, SPACING, (width, law))
}

fn lattices(rest: &[[f32; 2]]) -> Lattices {
    wide_lattices(rest, 3.5, LAW)
}

/// That of the only body.
fn lattice(rest: &[[f32; 2]]) -> Lattice {
    let [lattice] = &lattices(rest).bodies[..] else { panic!("one body") };
    lattice.clone()
}

/// The impulses of all particles in a stream's first frame.
fn impulses(
    lattices: &Lattices,
    law: &Elasticity,
    walls: &Walls,
    position: &[[f32; 2]],
    velocity: &[[f32; 2]],
) -> Vec<Impulse> {
    let mut lattices = lattices.clone();
    lattices.bodies.iter_mut().for_each(|body| body.elasticity = *law);
    let mut expected = lattices.expected();
    later_impulses(&lattices, &mut expected, walls, (position, velocity))
}

/// Those in a frame for which this is expected.
fn later_impulses(
    lattices: &Lattices,
    expected: &mut Expected,
    walls: &Walls,
    motion: (&[[f32; 2]], &[[f32; 2]]),
) -> Vec<Impulse> {
    let mut found = vec![Impulse::default(); motion.0.len()];
    let mut scratch = Scratch::default();
    for body in 0..lattices.bodies.len() {
        let nodes = lattices.nodes(body);
        let expected = (&mut expected.positions[nodes], &mut expected.most_errors[body]);
        for (row, impulse) in lattices.impulses(body, walls, motion, expected, &mut scratch) {
            found[row] = impulse;
        }
    }
    found
}

/// The next frame.
fn advance(
    lattices: &Lattices,
    (law, walls): (&Elasticity, &Walls),
    position: &mut [[f32; 2]],
    velocity: &mut [[f32; 2]],
) {
    let all = impulses(lattices, law, walls, position, velocity);
    follow(&all, law, position, velocity);
}

/// The next frame after these impulses.
fn follow(
    impulses: &[Impulse],
    law: &Elasticity,
    position: &mut [[f32; 2]],
    velocity: &mut [[f32; 2]],
) {
    for (row, Impulse { velocity_change, displacement }) in impulses.iter().enumerate() {
        for axis in 0..2 {
            let v = &mut velocity[row][axis];
            *v += velocity_change[axis];
            position[row][axis] += (*v + 0.5 * law.gravity[axis] * DT) * DT + displacement[axis];
            *v += law.gravity[axis] * DT;
        }
    }
}

/// NaN if a value is.
fn largest(values: impl Iterator<Item = [f32; 2]>) -> f32 {
    values.flatten().fold(0.0, |most, value| if value.abs() <= most { most } else { value.abs() })
}

#[test]
fn a_body_that_falls_and_turns_without_strain_has_no_impulse_but_the_centripetal_one() {
    let rest = block(21, 13);
    let lattices = lattices(&rest);
    let law = Elasticity { gravity: [0.5, -9.8], ..LAW };
    let still = vec![[0.3, -2.0]; rest.len()];
    let found = impulses(&lattices, &law, &FAR, &rest, &still);
    let most = largest(found.iter().flat_map(|own| [own.velocity_change, own.displacement]));
    assert!(most < 1e-3, "{most}");

    // Turned by a right angle, and turning at 1 rad/s about the centre.
    let turned: Vec<_> = rest.iter().map(|[x, y]| [-y, *x]).collect();
    let center = [-0.3 - 6.0 * SPACING, 0.3 + 10.0 * SPACING];
    let turning: Vec<_> = turned.iter().map(|[x, y]| [center[1] - y, x - center[0]]).collect();
    let found = impulses(&lattices, &LAW, &FAR, &turned, &turning);
    for (Impulse { velocity_change: change, .. }, [x, y]) in found.iter().zip(&turned) {
        // Within a frame, a velocity turns by 16 mrad.
        let expected = [DT * (center[0] - x), DT * (center[1] - y)];
        let apart = largest([[change[0] - expected[0], change[1] - expected[1]]].into_iter());
        assert!(apart < 1e-3, "{change:?}, expected {expected:?}");
    }
}

#[test]
fn nodes_take_part_in_every_affine_deformation_and_bilinear_motions_are_fitted_exactly() {
    // A body with a notch, and elements that it hardly fills.
    let mut rest = block(25, 17);
    rest.retain(|[x, y]| *x < 0.3 + 9.5 * SPACING || *y < 0.3 + 9.5 * SPACING);
    let lattice = lattice(&rest);
    let deformed: Vec<_> =
        rest.iter().map(|[x, y]| [1.1 * x + 0.3 * y, 0.9 * y - 0.2 * x]).collect();
    let mut scratch = Scratch::default();
    lattice.fit((&deformed, &rest), &mut scratch);
    for node in &scratch.nodes {
        // Velocities were fitted to the rest positions.
        let [x, y] = node.velocity;
        let expected = [1.1 * x + 0.3 * y, 0.9 * y - 0.2 * x];
        let found = node.position;
        let apart = largest([[found[0] - expected[0], found[1] - expected[1]]].into_iter());
        assert!(apart < 1e-5, "{node:?}: {apart}");
    }
    // Any motion of the nodes, interpolated at the particles, is found again.
    let motion = |node: usize| [(7 * node % 11) as f32 - 5.0, (5 * node % 13) as f32 - 6.0];
    let mut moved = vec![[0.0; 2]; rest.len()];
    for (&row, corners) in lattice.rows().iter().zip(lattice.corners()) {
        for Share { index, weight } in corners {
            add_scaled(&mut moved[row as usize], *weight, motion(*index as usize));
        }
    }
    lattice.fit((&rest, &moved), &mut scratch);
    for (number, node) in scratch.nodes.iter().enumerate() {
        let (found, expected) = (node.velocity, motion(number));
        let apart = largest([[found[0] - expected[0], found[1] - expected[1]]].into_iter());
        assert!(apart < 1e-3, "node {number}: {found:?}, expected {expected:?}");
    }
    // The inverse that other devices use.
    let band = lattice.normal_equations();
    let (inverse, count) = (band.inverse(), scratch.nodes.len());
    for row in 0..count {
        let mut sums = vec![0.0; count];
        for corners in lattice.corners() {
            let own: f32 =
                corners.iter().map(|a| a.weight * inverse[row * count + a.index as usize]).sum();
            corners.iter().for_each(|b| sums[b.index as usize] += b.weight * own);
        }
        sums[row] -= 1.0;
        let most = sums.iter().fold(0.0f32, |most, sum| most.max(sum.abs()));
        assert!(most < 1e-3, "row {row}: {most}");
    }
}

/// The lowest mode of a bar that is free at both ends: u = a cos(pi X / L), of frequency c / (2 L).
#[test]
fn a_bar_swings_at_the_frequency_of_its_pressure_waves() {
    let (columns, rows) = (81, 9);
    let rest = block(columns, rows);
    let lattices = lattices(&rest);
    let length = columns as f32 * SPACING;
    let shape = |x: f32| (std::f32::consts::PI * (x - 0.3 + 0.5 * SPACING) / length).cos();
    let mut position: Vec<_> = rest.iter().map(|&[x, y]| [x + 0.004 * shape(x), y]).collect();
    let mut velocity = vec![[0.0; 2]; rest.len()];
    let amplitude = |position: &[[f32; 2]]| {
        let parts =
            position.iter().zip(&rest).map(|(now, rest)| (now[0] - rest[0]) * shape(rest[0]));
        2.0 * parts.sum::<f32>() / rest.len() as f32
    };
    // The first zero is after a quarter of a period, L / (2 c).
    let expected = length / (2.0 * 300f32.sqrt());
    let (mut frame, mut last) = (0, amplitude(&position));
    let zero = loop {
        advance(&lattices, (&LAW, &FAR), &mut position, &mut velocity);
        frame += 1;
        let now = amplitude(&position);
        if now <= 0.0 {
            break DT * (frame as f32 - now / (now - last));
        }
        assert!(frame < 100);
        last = now;
    };
    assert!((zero / expected - 1.0).abs() < 0.05, "{zero} s, expected {expected} s");
}

#[test]
fn forces_within_a_body_keep_its_momentum_and_without_viscosity_its_vibration() {
    let rest = block(33, 17);
    let lattices = lattices(&rest);
    let mut position: Vec<_> = rest.iter().map(|[x, y]| [0.97 * x, 1.02 * y + 0.05 * x]).collect();
    let mut velocity: Vec<_> = rest.iter().map(|[x, y]| [1.0 - y, *x]).collect();
    let mean = |velocity: &[[f32; 2]], axis: usize| {
        velocity.iter().map(|v| v[axis]).sum::<f32>() / velocity.len() as f32
    };
    let energy = |velocity: &[[f32; 2]]| {
        let apart = |v: &[f32; 2]| [0, 1].map(|axis| v[axis] - mean(velocity, axis));
        let squares = velocity.iter().map(|v| apart(v).iter().map(|v| v * v).sum::<f32>());
        0.5 * squares.sum::<f32>() / velocity.len() as f32
    };
    let before = [0, 1].map(|axis| mean(&velocity, axis));
    let mut energies = Vec::new();
    for _ in 0..60 {
        advance(&lattices, (&LAW, &FAR), &mut position, &mut velocity);
        energies.push(energy(&velocity));
    }
    for axis in 0..2 {
        let after = mean(&velocity, axis);
        assert!((after - before[axis]).abs() < 0.02, "{before:?}, {after}");
    }
    // Potential energy comes and goes: over many frames, the mean stays.
    let [early, late] = [0..20, 40..60].map(|range| energies[range].iter().sum::<f32>());
    assert!((0.6..1.6).contains(&(late / early)), "{early}, {late}");
}

#[test]
fn viscosity_damps_vibration_but_neither_motion_nor_rotation() {
    let rest = block(33, 17);
    let lattices = lattices(&rest);
    let law = Elasticity { viscosity: 0.1, ..LAW };
    let still = vec![[0.0; 2]; rest.len()];
    let bent: Vec<_> = rest.iter().map(|[x, y]| [0.97 * x, 1.02 * y + 0.05 * x]).collect();
    let energy = |law: &Elasticity| {
        let (mut position, mut velocity) = (bent.clone(), still.clone());
        (0..40)
            .map(|_| {
                advance(&lattices, (law, &FAR), &mut position, &mut velocity);
                velocity.iter().flatten().map(|v| v * v).sum::<f32>()
            })
            .skip(30)
            .sum::<f32>()
    };
    let (damped, free) = (energy(&law), energy(&LAW));
    assert!(damped < 0.3 * free, "{damped}, {free}");
    // A turn, by a right angle, at 1 rad/s.
    let turned: Vec<_> = rest.iter().map(|[x, y]| [-y, *x]).collect();
    let turning: Vec<_> = turned.iter().map(|[x, y]| [3.0 - y, x + 1.0]).collect();
    let with = |law| impulses(&lattices, law, &FAR, &turned, &turning);
    for (found, expected) in with(&law).iter().zip(with(&LAW)) {
        let (found, expected) = (found.velocity_change, expected.velocity_change);
        let apart = largest([[found[0] - expected[0], found[1] - expected[1]]].into_iter());
        assert!(apart < 2e-3, "{found:?}, {expected:?}");
    }
}

#[test]
fn a_body_that_hits_the_floor_rebounds_with_most_of_its_speed() {
    let rest = block(21, 21);
    let lattices = lattices(&rest);
    let floor = Walls { lower: [-9.0, 0.29], ..FAR };
    let mut position = rest.clone();
    let mut velocity = vec![[0.5, -2.0]; rest.len()];
    for _ in 0..12 {
        advance(&lattices, (&LAW, &floor), &mut position, &mut velocity);
    }
    let mean = |axis: usize| velocity.iter().map(|v| v[axis]).sum::<f32>() / rest.len() as f32;
    assert!((mean(0) - 0.5).abs() < 0.02, "slides on at {}", mean(0));
    assert!((1.5..2.05).contains(&mean(1)), "rises at {}", mean(1));
    let lowest = position.iter().fold(f32::MAX, |low, [_, y]| low.min(*y));
    assert!(lowest > 0.27, "{lowest}");
}

#[test]
fn bodies_are_connected_particles_of_jelly_and_have_lattices_of_their_own() {
    let one = block(9, 9);
    let far: Vec<_> = one.iter().map(|[x, y]| [x + 0.3, *y]).collect();
    let few: Vec<_> = block(3, 3).iter().map(|[x, y]| [*x, y + 0.3]).collect();
    let rest: Vec<_> = [one.clone(), far.clone(), far, few].concat();
    let material = [vec![Material::Jelly; 162], vec![Material::Rope; 81], vec![Material::Jelly; 9]];
    let material = material.concat();
    let shape = RestShape::new(&rest, &material, 1, SPACING);
    let both = Lattices::new((&shape, 0..rest.len()), &rest, &material, SPACING, (4.0, LAW));
    let rows: Vec<_> = both.bodies().iter().flat_map(|body| body.rows().to_vec()).collect();
    assert_eq!(rows, (0..162).collect::<Vec<_>>(), "neither rope nor the nine particles");
    // A velocity of one body gives the other no impulse.
    let velocity: Vec<_> =
        rest.iter().map(|[x, y]| if *x < 0.5 { [9.0 * y, 0.0] } else { [0.0; 2] }).collect();
    let found = impulses(&both, &LAW, &FAR, &rest, &velocity);
    let [moved, still] =
        [0..81, 81..162].map(|rows| largest(found[rows].iter().map(|own| own.velocity_change)));
    assert!(moved > 0.1 && still < 1e-3, "{moved}, {still}");
    // The order of rows does not matter.
    let order: Vec<u32> = (0..rest.len() as u32).rev().collect();
    let reversed = both.permuted(&order);
    let turned = |values: &[[f32; 2]]| values.iter().rev().copied().collect::<Vec<_>>();
    let back = impulses(&reversed, &LAW, &FAR, &turned(&rest), &turned(&velocity));
    assert_eq!(back.into_iter().rev().collect::<Vec<_>>(), found);
}

#[test]
fn bodies_that_almost_touched_have_lattices_of_their_own_and_those_that_touched_come_apart() {
    let left = block(13, 13);
    let right = |gap: f32| -> Vec<_> {
        block(13, 13).into_iter().map(|[x, y]| [x + (12.0 + gap) * SPACING, y]).collect()
    };
    let near = [left.clone(), right(1.6)].concat();
    assert_eq!(lattices(&near).bodies().len(), 2);
    let rest = [left.clone(), right(1.0)].concat();
    let lattices = lattices(&rest);
    assert_eq!(lattices.bodies().len(), 1);
    // Where they come apart, the lattice between them is torn.
    let squeezed = |[x, y]: [f32; 2]| [x, 0.95 * y];
    for (gap, moves) in [(1.0, true), (3.0, false), (9.0, false)] {
        let position: Vec<_> =
            [left.clone(), right(gap)].concat().into_iter().map(squeezed).collect();
        let still = vec![[0.0; 2]; rest.len()];
        let found = impulses(&lattices, &LAW, &FAR, &position, &still);
        let most = largest(found.iter().map(|own| own.velocity_change));
        assert!(if moves { most > 0.1 } else { most == 0.0 }, "{gap}: {most}");
    }
}

/// One element, as wide as the body: steps are as short as it needs them.
#[test]
fn narrow_bodies_of_stiff_jelly_have_short_steps_and_rebound_from_a_wall() {
    let rest = block(6, 40);
    let of = |modulus: f32| {
        let rate = modulus.sqrt() / (3.5 * SPACING);
        let law = Elasticity { lame: [0.5 * modulus, 0.0], wall_stiffness: rate * rate, ..LAW };
        wide_lattices(&rest, 60.0, law)
    };
    for modulus in [300.0, 3e4, 1e5] {
        let lattices = of(modulus);
        let lattice = &lattices.bodies[0];
        assert_eq!(lattice.inverse_mass().len(), 4);
        let crossings = DT * modulus.sqrt() / (6.0 * SPACING);
        assert!(lattice.elasticity().steps as f32 >= STEPS_PER_CROSSING * crossings);
        let wall = Walls { upper: [0.4, 9.0], ..FAR };
        let (mut position, mut velocity) = (rest.clone(), vec![[3.0, 0.0]; rest.len()]);
        for frame in 0..8 {
            advance(&lattices, (&lattice.elasticity, &wall), &mut position, &mut velocity);
            let speed = largest(velocity.iter().copied());
            assert!(speed < 8.0, "modulus {modulus}, frame {frame}: {speed}");
        }
        let mean = velocity.iter().map(|v| v[0]).sum::<f32>() / rest.len() as f32;
        assert!(mean < -1.0, "modulus {modulus}: turned back at {mean}");
    }
    // More steps than there may be.
    assert!(of(1e8).is_empty());
}

/// Squeezed jelly, between other particles.
#[test]
fn a_body_has_an_impulse_only_while_nothing_else_is_close() {
    let (jelly, other) = (block(14, 14), block(10, 14));
    for kind in [Material::Jelly, Material::Liquid] {
        let at = |gap: f32| other.iter().map(move |[x, y]| [x + (13.0 + gap) * SPACING, *y]);
        let rest: Vec<_> = jelly.iter().copied().chain(at(20.0)).collect();
        let material = [vec![Material::Jelly; 196], vec![kind; 140]].concat();
        let shape = RestShape::new(&rest, &material, 1, SPACING);
        let rows = (&shape, 0..rest.len());
        let lattices = Lattices::new(rows, &rest, &material, SPACING, (3.5, LAW));
        let number = if kind == Material::Jelly { 1 } else { Lattices::NO_BODY };
        assert_eq!(lattices.body_of(), [vec![0; 196], vec![number; 140]].concat());
        let squeezed = jelly.iter().map(|[x, y]| [*x, 0.95 * y]);
        let velocity = vec![[0.0; 2]; rest.len()];
        // The outermost parts of the surface are half a part inside of it.
        for (gap, moves) in [(9.0, true), (5.0, false), (-3.0, false)] {
            let position: Vec<_> = squeezed.clone().chain(at(gap)).collect();
            let found = impulses(&lattices, &LAW, &FAR, &position, &velocity);
            let most = largest(found.iter().map(|own| own.velocity_change));
            assert!(if moves { most > 0.1 } else { most == 0.0 }, "{kind:?}, {gap}: {most}");
        }
        // What has no place is not close.
        let lost = vec![[f32::NAN; 2]; 140];
        let position: Vec<_> = squeezed.chain(lost).collect();
        let found = impulses(&lattices, &LAW, &FAR, &position, &velocity);
        assert!(largest(found[..196].iter().map(|own| own.velocity_change)) > 0.1);
    }
}

/// Squeezed jelly that vibrates while it falls.
#[test]
fn a_lattice_that_was_wrong_in_the_last_frame_gives_no_impulse() {
    let rest = block(17, 13);
    let law = Elasticity { gravity: [0.0, -9.8], ..LAW };
    let lattices = wide_lattices(&rest, 3.5, law);
    let mut expected = lattices.expected();
    let mut position: Vec<_> = rest.iter().map(|[x, y]| [*x, 0.995 * y]).collect();
    let mut velocity = vec![[1.0, 0.5]; rest.len()];
    // Domain lengths per second squared.
    let pull = |push: f32| [push * DT, 0.5 * push * DT * DT];
    let mut frame = |push: f32| {
        let all = later_impulses(&lattices, &mut expected, &FAR, (&position, &velocity));
        // What moves is what a lattice expects, whether it may move it or not.
        let motion = impulses(&lattices, &law, &FAR, &position, &velocity);
        follow(&motion, &law, &mut position, &mut velocity);
        let [faster, farther] = pull(push);
        velocity.iter_mut().for_each(|[x, _]| *x += faster);
        position.iter_mut().for_each(|[x, _]| *x += farther);
        largest(all.iter().map(|own| own.velocity_change)) > 0.0
    };
    // A tenth of gravity is not noticed, gravity's own size is; a frame later it moves again.
    let pushes = [0.0, 0.0, 1.0, 0.0, 9.8, 9.8, 0.0, 0.0];
    let moved = pushes.map(&mut frame);
    assert_eq!(moved, [true, true, true, true, true, false, false, true]);
    // A jump of all nodes: without a limit of errors the lattice still moves its body, and after a restart of the stream, too.
    let whole = impulses(&lattices, &law, &FAR, &position, &velocity);
    position.iter_mut().for_each(|[x, _]| *x += 0.1);
    let mut found = || later_impulses(&lattices, &mut expected, &FAR, (&position, &velocity));
    assert_eq!(found(), vec![Impulse::default(); rest.len()]);
    let mut any = lattices.clone();
    any.bodies[0].elasticity.most_error = f32::INFINITY;
    let mut unknown = any.expected();
    later_impulses(&any, &mut unknown, &FAR, (&rest, &velocity));
    let found = later_impulses(&any, &mut unknown, &FAR, (&position, &velocity));
    assert!(largest(found.iter().map(|own| own.velocity_change)) > 0.0);
    expected.forget();
    let found = later_impulses(&lattices, &mut expected, &FAR, (&position, &velocity));
    let apart = found.iter().zip(&whole).map(|(found, whole)| {
        [0, 1].map(|axis| found.velocity_change[axis] - whole.velocity_change[axis])
    });
    assert!(largest(apart) < 1e-3);
}

/// Jelly that is squeezed by a tenth, whose nodes then are off by a share of what they were moved.
#[test]
fn the_error_that_a_lattice_may_have_is_relative_to_what_it_moves() {
    let rest = block(17, 13);
    let law = Elasticity { small_error: 0.0, ..LAW };
    let lattices = wide_lattices(&rest, 3.5, law);
    let squeezed: Vec<_> = rest.iter().map(|[x, y]| [*x, 0.9 * y]).collect();
    let still = vec![[0.0; 2]; rest.len()];
    let mut expected = lattices.expected();
    let first = later_impulses(&lattices, &mut expected, &FAR, (&squeezed, &still));
    let (mut position, mut velocity) = (squeezed.clone(), still.clone());
    follow(&first, &law, &mut position, &mut velocity);
    // All nodes move along y, and a share of it is missing.
    for (missing, moves) in [(0.28, true), (0.35, false)] {
        let off: Vec<_> = position
            .iter()
            .zip(&squeezed)
            .map(|([x, y], [_, from])| [*x, y - missing * (y - from)])
            .collect();
        let found = later_impulses(&lattices, &mut expected.clone(), &FAR, (&off, &velocity));
        let most = largest(found.iter().map(|own| own.velocity_change));
        assert_eq!(most > 0.0, moves, "{missing}: {most}");
    }
}

/// A ring, whose parts and elements are partly empty: every part has nodes.
#[test]
fn parts_of_a_ring_have_nodes_at_any_width_of_elements() {
    let ring = |&[x, y]: &[f32; 2]| {
        let [dx, dy] = [x, y].map(|x| (x - 0.3) / SPACING - 15.0);
        (9.3..15.4).contains(&dx.hypot(dy))
    };
    let rest: Vec<_> = block(31, 31).into_iter().filter(ring).collect();
    for width in [3.5, 9.0, 30.0] {
        let lattice = &wide_lattices(&rest, width, LAW).bodies[0];
        let of_points: f32 = lattice.points().iter().map(|point| point.particles).sum();
        assert_eq!(of_points, rest.len() as f32);
        let of_surface: f32 = lattice.surface().iter().map(|part| part.particles).sum();
        assert!(of_surface > 0.5 * rest.len() as f32, "{of_surface} of a ring 6 spacings wide");
        for part in lattice.surface() {
            assert!(part.weights.iter().all(|weight| weight.abs() < 4.0), "{part:?}");
        }
    }
}

#[test]
fn a_lattice_that_diverges_gives_no_impulse() {
    let rest = block(9, 9);
    let lattices = lattices(&rest);
    let mut broken = rest.clone();
    broken[40] = [f32::NAN; 2];
    let squeezed: Vec<_> = rest.iter().map(|[x, y]| [0.9 * x, *y]).collect();
    let velocity = vec![[0.0; 2]; rest.len()];
    let stiff = Elasticity { lame: [1.5e6, 0.0], steps: 2, ..LAW };
    let found = impulses(&lattices, &LAW, &FAR, &squeezed, &velocity);
    assert!(largest(found.into_iter().map(|own| own.velocity_change)) > 0.1);
    let mut fast = velocity.clone();
    fast[40] = [f32::NAN; 2];
    for (position, velocity, law) in
        [(broken, &velocity, LAW), (squeezed.clone(), &fast, LAW), (squeezed, &velocity, stiff)]
    {
        let found = impulses(&lattices, &law, &FAR, &position, velocity);
        assert_eq!(found, vec![Impulse::default(); rest.len()]);
    }
}

/// Shape functions that are extrapolated far would give nodes negative masses.
#[test]
fn thin_parts_of_a_body_have_elements_of_their_own() {
    let mut rest = block(14, 14);
    let arm = (0..46 * 2).map(|k| [(14 + k % 46) as f32, (6 + k / 46) as f32]);
    rest.extend(arm.map(|at| at.map(|steps| 0.3 + steps * SPACING)));
    let lattices = lattices(&rest);
    assert_eq!(lattices.bodies[0].rows().len(), rest.len());
    let shares = lattices.bodies[0].corners().as_flattened();
    let most = shares.iter().fold(0.0f32, |most, share| most.max(share.weight.abs()));
    assert!(most < 4.0, "{most}");
    let mut position = rest.clone();
    let mut velocity: Vec<_> = rest.iter().map(|[x, y]| [0.0, 3.0 * x - y]).collect();
    for _ in 0..50 {
        advance(&lattices, (&LAW, &FAR), &mut position, &mut velocity);
    }
    let speed = largest(velocity.iter().copied());
    assert!(speed < 10.0, "{speed}");
}

/// A line of particles along the diagonal, whose box has far more elements than particles.
#[test]
fn a_body_in_a_far_larger_box_has_no_lattice() {
    let rest: Vec<_> = (0..60_000).map(|k| [0.7 * SPACING * k as f32; 2]).collect();
    for width in [3.5, 30.0] {
        assert!(wide_lattices(&rest, width, LAW).is_empty());
    }
}
