//! Minimum number of substeps per frame for stability.

use super::{
    error::Limit,
    material::{Lame, Materials},
};
use eddy_frames::Material;

/// Maximum Courant number of sound in solids: cells that a pressure wave crosses in a substep. Measured to be stable up to
/// about 1.
const CFL: f64 = 0.5;
/// The same for liquids, whose speed of sound increases with compression. With Taichi's law, splashes of the presets blew up
/// at 0.5 (four of six fluid scenes), lost area at 0.42 and were stable at 0.36 and below; with the law of water, one of
/// eight blew up at 0.4 and fourteen were stable at 0.32.
const LIQUID_CFL: f64 = 0.25;
/// Maximum `nu dt / dx^2` of a viscous liquid: the limit of explicit diffusion in two dimensions. Splashes were stable up to
/// 1.35 times this value.
const DIFFUSION: f64 = 0.25;
/// Maximum number of cells that a particle crosses in a substep.
pub(super) const TRAVEL: f64 = 0.5;

/// The minimum number of substeps in `interval` seconds for which the present materials are stable on a grid of cell width
/// `dx` (domain lengths) with particles of up to `speed` (domain lengths per second), and the limit that determines it.
pub fn minimum_substeps(
    present: &[Material],
    materials: &Materials,
    dx: f32,
    speed: f32,
    interval: f64,
) -> (u32, Limit) {
    let lame = Lame::of(materials.stiffness);
    let cells_crossed = |speed: f32| f64::from(speed) * interval / f64::from(dx);
    let travel = (cells_crossed(speed) / TRAVEL, Limit::Speed(speed));
    let sound = |material: Material| {
        let courant = if material == Material::Liquid { LIQUID_CFL } else { CFL };
        (cells_crossed(lame.sound_speed(material)) / courant, Limit::Sound(material))
    };
    let viscous = present.contains(&Material::Liquid) && materials.law.is_water();
    let viscosity = if viscous { materials.viscosity } else { 0.0 };
    let diffusion = f64::from(viscosity) * interval / f64::from(dx).powi(2) / DIFFUSION;
    let (substeps, limit) = present
        .iter()
        .map(|&material| sound(material))
        .chain([(diffusion, Limit::Viscosity(viscosity))])
        .fold(travel, |most, next| if next.0 > most.0 { next } else { most });
    // The cast saturates; settings reject far fewer than 2^32 substeps.
    (substeps.ceil().max(1.0) as u32, limit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn substeps_are_determined_by_the_fastest_sound() {
        let materials = Materials::default();
        let substeps =
            |present: &[Material]| minimum_substeps(present, &materials, 1.0 / 64.0, 1.0, 0.016).0;
        // c = sqrt(5 (lambda + 2 mu)) = 74.54, 74.54 * 0.016 * 64 / 0.5 = 152.7
        assert_eq!(substeps(&[Material::Liquid, Material::Snow]), 153);
        // c = sqrt(lambda) = 16.67, 16.67 * 0.016 * 64 / 0.25 = 68.3
        assert_eq!(substeps(&[Material::Liquid]), 69);
        assert!(substeps(&[Material::Jelly]) < substeps(&[Material::Rope]));
    }

    #[test]
    fn a_viscous_liquid_is_limited_by_its_viscosity() {
        let viscous = Materials { viscosity: 0.5, ..Materials::default() };
        let substeps =
            |present: &[Material]| minimum_substeps(present, &viscous, 1.0 / 64.0, 1.0, 0.016);
        // 4 * 0.5 * 0.016 * 64^2 = 131.1
        assert_eq!(substeps(&[Material::Liquid]), (132, Limit::Viscosity(0.5)));
        assert_eq!(substeps(&[Material::Rope]).1, Limit::Sound(Material::Rope));
    }

    #[test]
    fn a_fast_soft_material_is_limited_by_its_speed() {
        let soft = Materials { stiffness: 1.0, ..Materials::default() };
        let (substeps, limit) =
            minimum_substeps(&[Material::Liquid], &soft, 1.0 / 64.0, 10.0, 0.016);
        assert_eq!((substeps, limit), (21, Limit::Speed(10.0)));
    }
}
