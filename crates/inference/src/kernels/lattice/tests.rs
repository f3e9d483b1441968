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
    contact: Contact {
        distance: 3.5 * SPACING,
        stiffness: 0.2 * RATE * RATE,
        viscosity: 4.0 * RATE,
    },
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

fn lattice(rest: &[[f32; 2]]) -> Lattice {
    let material = vec![Material::Jelly; rest.len()];
    let shape = RestShape::new(rest, &material, 1, SPACING);
    Lattice::new((&shape, 0..rest.len()), rest, &material, SPACING, (3.5, LAW))
}

/// The impulses of all particles, which belong to one body.
fn impulses(
    lattice: &Lattice,
    law: &Elasticity,
    walls: &Walls,
    position: &[[f32; 2]],
    velocity: &[[f32; 2]],
) -> Vec<Impulse> {
    let mut found = vec![Impulse::default(); position.len()];
    let mut scratch = Scratch::default();
    let lattice = Lattice { elasticity: *law, ..lattice.clone() };
    for (row, impulse) in lattice.impulses(walls, (position, velocity), &mut scratch) {
        found[row] = impulse;
    }
    found
}

/// The next frame.
fn advance(
    lattice: &Lattice,
    (law, walls): (&Elasticity, &Walls),
    position: &mut [[f32; 2]],
    velocity: &mut [[f32; 2]],
) {
    let all = impulses(lattice, law, walls, position, velocity);
    for (row, Impulse { velocity_change, displacement }) in all.into_iter().enumerate() {
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
    let lattice = lattice(&rest);
    let law = Elasticity { gravity: [0.5, -9.8], ..LAW };
    let still = vec![[0.3, -2.0]; rest.len()];
    let found = impulses(&lattice, &law, &FAR, &rest, &still);
    let most = largest(found.iter().flat_map(|own| [own.velocity_change, own.displacement]));
    assert!(most < 1e-3, "{most}");

    // Turned by a right angle, and turning at 1 rad/s about the centre.
    let turned: Vec<_> = rest.iter().map(|[x, y]| [-y, *x]).collect();
    let center = [-0.3 - 6.0 * SPACING, 0.3 + 10.0 * SPACING];
    let turning: Vec<_> = turned.iter().map(|[x, y]| [center[1] - y, x - center[0]]).collect();
    let found = impulses(&lattice, &LAW, &FAR, &turned, &turning);
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
    let [band] = lattice.normal_equations() else { panic!("one body") };
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
    let lattice = lattice(&rest);
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
        advance(&lattice, (&LAW, &FAR), &mut position, &mut velocity);
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
    let lattice = lattice(&rest);
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
        advance(&lattice, (&LAW, &FAR), &mut position, &mut velocity);
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
    let lattice = lattice(&rest);
    let law = Elasticity { viscosity: 0.1, ..LAW };
    let still = vec![[0.0; 2]; rest.len()];
    let bent: Vec<_> = rest.iter().map(|[x, y]| [0.97 * x, 1.02 * y + 0.05 * x]).collect();
    let energy = |law: &Elasticity| {
        let (mut position, mut velocity) = (bent.clone(), still.clone());
        (0..40)
            .map(|_| {
                advance(&lattice, (law, &FAR), &mut position, &mut velocity);
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
    let with = |law| impulses(&lattice, law, &FAR, &turned, &turning);
    for (found, expected) in with(&law).iter().zip(with(&LAW)) {
        let (found, expected) = (found.velocity_change, expected.velocity_change);
        let apart = largest([[found[0] - expected[0], found[1] - expected[1]]].into_iter());
        assert!(apart < 2e-3, "{found:?}, {expected:?}");
    }
}

#[test]
fn a_body_that_hits_the_floor_rebounds_with_most_of_its_speed() {
    let rest = block(21, 21);
    let lattice = lattice(&rest);
    let floor = Walls { lower: [-9.0, 0.29], ..FAR };
    let mut position = rest.clone();
    let mut velocity = vec![[0.5, -2.0]; rest.len()];
    for _ in 0..12 {
        advance(&lattice, (&LAW, &floor), &mut position, &mut velocity);
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
    let both = Lattice::new((&shape, 0..rest.len()), &rest, &material, SPACING, (4.0, LAW));
    let rows: Vec<_> = both.rows().iter().map(|&row| row as usize).collect();
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
    assert_eq!(lattice(&near).normal_equations().len(), 2);
    let rest = [left.clone(), right(1.0)].concat();
    let lattice = lattice(&rest);
    assert_eq!(lattice.normal_equations().len(), 1);
    // At two elements apart, they hardly pull each other.
    let position = [left, right(9.0)].concat();
    let still = vec![[0.0; 2]; rest.len()];
    let found = impulses(&lattice, &LAW, &FAR, &position, &still);
    let mean: f32 = found[..169].iter().map(|own| own.velocity_change[0]).sum::<f32>() / 169.0;
    assert!(mean.abs() < 0.2, "{mean}");
}

/// A body hits another of a third of its mass, which lies still, without gravity and walls.
#[test]
fn bodies_that_meet_exchange_momentum_and_do_not_enter_each_other() {
    let (left, right) = (block(21, 21), block(7, 21));
    let gap = 30.0 * SPACING;
    let moved: Vec<_> = right.into_iter().map(|[x, y]| [x + gap, y + 3.0 * SPACING]).collect();
    let rest = [left, moved].concat();
    let lattice = lattice(&rest);
    assert_eq!(lattice.surfaces().len(), 2);
    let of_left = |row: usize| row < 21 * 21;
    let mut position = rest.clone();
    let start = |row| if of_left(row) { [3.0, 0.2] } else { [0.0; 2] };
    let mut velocity: Vec<_> = (0..rest.len()).map(start).collect();
    let mean =
        |of: &[[f32; 2]], axis: usize| of.iter().map(|v| v[axis]).sum::<f32>() / of.len() as f32;
    let total = [0, 1].map(|axis| mean(&velocity, axis));
    for frame in 0..20 {
        advance(&lattice, (&LAW, &FAR), &mut position, &mut velocity);
        for (axis, total) in total.iter().enumerate() {
            let now = mean(&velocity, axis);
            assert!((now - total).abs() < 0.01, "frame {frame}: {now} instead of {total}");
        }
        let [left, right] = [&position[..21 * 21], &position[21 * 21..]];
        let front = left.iter().fold(f32::MIN, |most, place| most.max(place[0]));
        let back = right.iter().fold(f32::MAX, |least, place| least.min(place[0]));
        assert!(back - front > 0.5 * SPACING, "frame {frame}: {front}, {back}");
    }
    let [left, right] = [&velocity[..21 * 21], &velocity[21 * 21..]].map(|own| mean(own, 0));
    // Together at 2.25, and faster than that where they spring apart.
    assert!(right > 2.25 && left < 2.25, "{left}, {right}");
    // Bodies that are further apart than contact do nothing to each other.
    let still = vec![[0.0; 2]; rest.len()];
    let found = impulses(&lattice, &LAW, &FAR, &rest, &still);
    assert!(largest(found.iter().map(|own| own.velocity_change)) < 1e-3);
}

/// One element for each body, as wide as it is: steps are as short as the narrower needs them.
#[test]
fn narrow_bodies_of_stiff_jelly_have_short_steps_and_meet_each_other_and_a_wall() {
    let block = |columns: usize, x: f32| {
        block(columns, 40).into_iter().map(move |place| [place[0] + x, place[1]])
    };
    let rest: Vec<_> = block(30, 0.0).chain(block(6, 0.4)).collect();
    let material = vec![Material::Jelly; rest.len()];
    let shape = RestShape::new(&rest, &material, 1, SPACING);
    let lattice = |modulus: f32| {
        let rate = modulus.sqrt() / (3.5 * SPACING);
        let contact =
            Contact { stiffness: 0.2 * rate * rate, viscosity: 4.0 * rate, ..LAW.contact };
        let wall_stiffness = rate * rate;
        let law = Elasticity { lame: [0.5 * modulus, 0.0], wall_stiffness, contact, ..LAW };
        Lattice::new((&shape, 0..rest.len()), &rest, &material, SPACING, (60.0, law))
    };
    for modulus in [300.0, 3e4, 1e5] {
        let lattice = lattice(modulus);
        assert_eq!(lattice.inverse_mass().len(), 8);
        let crossings = DT * modulus.sqrt() / (6.0 * SPACING);
        assert!(lattice.elasticity().steps as f32 >= STEPS_PER_CROSSING * crossings);
        // The wide body hits the narrow one, which hits a wall.
        let wall = Walls { upper: [0.8, 9.0], ..FAR };
        let mut position = rest.clone();
        let speed = |row| if row < 1200 { [3.0, 0.0] } else { [0.0; 2] };
        let mut velocity: Vec<_> = (0..rest.len()).map(speed).collect();
        for frame in 0..25 {
            advance(&lattice, (&lattice.elasticity, &wall), &mut position, &mut velocity);
            let speed = largest(velocity.iter().copied());
            assert!(speed < 12.0, "modulus {modulus}, frame {frame}: {speed}");
        }
        let mean = |rows: Range<usize>| {
            let count = rows.len() as f32;
            velocity[rows].iter().map(|v| v[0]).sum::<f32>() / count
        };
        assert!(mean(0..1200) < 0.0, "modulus {modulus}: turned back at {}", mean(0..1200));
        let right = largest(position[1200..].iter().map(|place| [place[0], 0.0]));
        assert!(right < 0.82, "modulus {modulus}: {right}");
    }
    // More steps than there may be.
    assert!(lattice(1e8).is_empty());
}

#[test]
fn a_body_that_diverges_leaves_others_alone() {
    let near: Vec<_> = block(9, 9).into_iter().map(|[x, y]| [x + 11.0 * SPACING, y]).collect();
    let rest = [block(9, 9), near].concat();
    let lattice = lattice(&rest);
    let toward = |row: usize| if row < 81 { [1.0, 0.0] } else { [-1.0, 0.0] };
    let velocity: Vec<_> = (0..162).map(toward).collect();
    let squeezed: Vec<_> = rest.iter().map(|[x, y]| [*x, 0.9 * y]).collect();
    for broken in [40, 81 + 40] {
        let mut position = squeezed.clone();
        position[broken] = [f32::NAN; 2];
        let found = impulses(&lattice, &LAW, &FAR, &position, &velocity);
        let of = |rows: Range<usize>| largest(found[rows].iter().map(|own| own.velocity_change));
        let (own, other) = if broken < 81 { (0..81, 81..162) } else { (81..162, 0..81) };
        assert!(of(own.clone()) == 0.0 && of(other.clone()) > 0.1, "{}, {}", of(own), of(other));
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
        let material = vec![Material::Jelly; rest.len()];
        let shape = RestShape::new(&rest, &material, 1, SPACING);
        let rows = (&shape, 0..rest.len());
        let lattice = Lattice::new(rows, &rest, &material, SPACING, (width, LAW));
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
    let lattice = lattice(&rest);
    let mut broken = rest.clone();
    broken[40] = [f32::NAN; 2];
    let squeezed: Vec<_> = rest.iter().map(|[x, y]| [0.9 * x, *y]).collect();
    let velocity = vec![[0.0; 2]; rest.len()];
    let stiff = Elasticity { lame: [1.5e6, 0.0], steps: 2, ..LAW };
    let found = impulses(&lattice, &LAW, &FAR, &squeezed, &velocity);
    assert!(largest(found.into_iter().map(|own| own.velocity_change)) > 0.1);
    for (position, law) in [(broken, LAW), (squeezed, stiff)] {
        let found = impulses(&lattice, &law, &FAR, &position, &velocity);
        assert_eq!(found, vec![Impulse::default(); rest.len()]);
    }
}

/// Shape functions that are extrapolated far would give nodes negative masses.
#[test]
fn thin_parts_of_a_body_have_elements_of_their_own() {
    let mut rest = block(14, 14);
    let arm = (0..46 * 2).map(|k| [(14 + k % 46) as f32, (6 + k / 46) as f32]);
    rest.extend(arm.map(|at| at.map(|steps| 0.3 + steps * SPACING)));
    let lattice = lattice(&rest);
    assert_eq!(lattice.rows().len(), rest.len());
    let shares = lattice.corners().as_flattened();
    let most = shares.iter().fold(0.0f32, |most, share| most.max(share.weight.abs()));
    assert!(most < 4.0, "{most}");
    let mut position = rest.clone();
    let mut velocity: Vec<_> = rest.iter().map(|[x, y]| [0.0, 3.0 * x - y]).collect();
    for _ in 0..50 {
        advance(&lattice, (&LAW, &FAR), &mut position, &mut velocity);
    }
    let speed = largest(velocity.iter().copied());
    assert!(speed < 10.0, "{speed}");
}

/// A line of particles along the diagonal, whose box has far more elements than particles.
#[test]
fn a_body_in_a_far_larger_box_has_no_lattice() {
    let rest: Vec<_> = (0..60_000).map(|k| [0.7 * SPACING * k as f32; 2]).collect();
    let material = vec![Material::Jelly; rest.len()];
    let shape = RestShape::new(&rest, &material, 1, SPACING);
    for width in [3.5, 30.0] {
        let rows = (&shape, 0..rest.len());
        assert!(Lattice::new(rows, &rest, &material, SPACING, (width, LAW)).is_empty());
    }
}
