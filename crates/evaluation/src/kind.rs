//! Kinds of scenes by material: results are grouped by them.

use serde::{Deserialize, Serialize};

use eddy_frames::Material;

/// A kind of scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// Liquid alone.
    Liquid,
    /// Snow alone.
    Snow,
    /// Jelly alone.
    Jelly,
    /// Rope alone.
    Rope,
    /// Sand alone.
    Sand,
    /// Several materials.
    Mixed,
}

impl Kind {
    /// Every kind.
    pub const ALL: [Self; 6] =
        [Self::Liquid, Self::Snow, Self::Jelly, Self::Rope, Self::Sand, Self::Mixed];

    /// The kind of a scene with particles of these materials.
    pub fn of(material: &[Material]) -> Self {
        match material {
            [first, rest @ ..] if rest.iter().all(|other| other == first) => match first {
                Material::Liquid => Self::Liquid,
                Material::Snow => Self::Snow,
                Material::Jelly => Self::Jelly,
                Material::Rope => Self::Rope,
                Material::Sand => Self::Sand,
            },
            _ => Self::Mixed,
        }
    }

    /// Its name in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Liquid => "liquid",
            Self::Snow => "snow",
            Self::Jelly => "jelly",
            Self::Rope => "rope",
            Self::Sand => "sand",
            Self::Mixed => "mixed",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_is_of_its_only_material_or_mixed() {
        for (material, kind) in Material::ALL.into_iter().zip(Kind::ALL) {
            assert_eq!(Kind::of(&[material; 3]), kind);
            assert_eq!(kind.name(), material.name());
        }
        assert_eq!(Kind::of(&[Material::Rope, Material::Rope, Material::Snow]), Kind::Mixed);
    }
}
