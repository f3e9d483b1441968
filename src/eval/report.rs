//! What a judgement says: for programs (JSON, CSV) and for people (tables).

use std::{fmt::Write as _, fs, io, path::Path};

use comfy_table::{Table, presets::UTF8_BORDERS_ONLY};
use serde::Serialize;

use super::{ErrorSums, Errors, Judgement};
use crate::frame::Material;

/// The frames ahead that tables show.
const SHOWN: [usize; 6] = [1, 5, 10, 20, 50, 100];

/// A model beside its baselines.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// The model's name: where it was loaded from.
    pub checkpoint: String,
    /// Digest of the checkpoint.
    pub digest: String,
    /// Digest of the judged streams.
    pub data_digest: String,
    /// Judged streams.
    pub streams: usize,
    /// Free rollouts.
    pub windows: usize,
    /// Rollouts in which the model predicted something that is not finite. They are not left out:
    /// their last finite frame counts as the prediction.
    pub diverged_windows: usize,
    /// Length of a rollout (frames).
    pub horizon: usize,
    /// Time between two frames (s).
    pub dt: f32,
    /// The model, then the baselines.
    pub predictors: Vec<PredictorReport>,
    /// Skill of each material and their mean: 1 - squared position error / that of the best baseline,
    /// both summed over windows; one number a frame ahead.
    pub skill: Vec<MaterialSkill>,
}

/// Errors of one predictor; one number a frame ahead.
#[derive(Clone, Debug, Serialize)]
pub struct PredictorReport {
    /// `model` or the baseline's name.
    pub name: String,
    /// Over all particles.
    #[serde(flatten)]
    pub all: MaterialErrors,
    /// For each material that occurs.
    pub materials: Vec<(Material, MaterialErrors)>,
}

/// Error curves; one number a frame ahead.
#[derive(Clone, Debug, Serialize)]
pub struct MaterialErrors {
    /// Root mean square of |x - x'| (domain lengths).
    pub position_rmse: Vec<f64>,
    /// Root mean square of |v - v'| (domain lengths per second).
    pub velocity_rmse: Vec<f64>,
    /// Mean squared error of the MinMax-normalised features x, y, vx, vy.
    pub minmax_mse: Vec<f64>,
}

/// Skill of one material, or the mean of all; one number a frame ahead.
#[derive(Clone, Debug, Serialize)]
pub struct MaterialSkill {
    /// The material's name, or `mean`.
    pub name: &'static str,
    /// The curve.
    pub skill: Vec<f64>,
}

impl MaterialErrors {
    fn new(errors: &[Errors]) -> Self {
        let curve = |f: fn(&Errors) -> f64| errors.iter().map(f).collect();
        Self {
            position_rmse: curve(Errors::position_rmse),
            velocity_rmse: curve(Errors::velocity_rmse),
            minmax_mse: curve(Errors::minmax_mse),
        }
    }
}

impl Report {
    /// Puts the report of a judgement together.
    pub fn new(
        checkpoint: String,
        digest: String,
        data_digest: String,
        streams: usize,
        dt: f32,
        judgement: &Judgement,
    ) -> Self {
        let baselines = judgement.baselines.iter().map(|(baseline, sums)| (baseline.name(), sums));
        let predictors: Vec<_> = std::iter::once(("model", &judgement.model))
            .chain(baselines)
            .map(|(name, sums)| PredictorReport {
                name: name.to_owned(),
                all: MaterialErrors::new(&sums.total()),
                materials: present(&judgement.model)
                    .map(|material| (material, MaterialErrors::new(&sums.of(material))))
                    .collect(),
            })
            .collect();
        Self {
            checkpoint,
            digest,
            data_digest,
            streams,
            windows: judgement.windows,
            diverged_windows: judgement.diverged,
            horizon: predictors[0].all.position_rmse.len(),
            dt,
            predictors,
            skill: skills(judgement),
        }
    }

    /// Skill `ahead` frames ahead (from 1), the mean over materials.
    pub fn mean_skill(&self, ahead: usize) -> Option<f64> {
        self.skill.last()?.skill.get(ahead.checked_sub(1)?).copied()
    }

    /// Writes `report.json` and `curves.csv` into `folder`, which is made if it is not there.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&self, folder: &Path) -> io::Result<()> {
        fs::create_dir_all(folder)?;
        let json = serde_json::to_string_pretty(self).map_err(io::Error::other)?;
        fs::write(folder.join("report.json"), json + "\n")?;
        fs::write(folder.join("curves.csv"), self.curves())
    }

    /// Every curve as CSV, one row a frame ahead.
    fn curves(&self) -> String {
        let mut csv = String::from("frame");
        let mut columns: Vec<&[f64]> = Vec::new();
        for predictor in &self.predictors {
            let name = predictor.name.replace(' ', "_");
            for (quantity, curve) in [
                ("position_rmse", &predictor.all.position_rmse),
                ("velocity_rmse", &predictor.all.velocity_rmse),
                ("minmax_mse", &predictor.all.minmax_mse),
            ] {
                let _ = write!(csv, ",{name}_{quantity}");
                columns.push(curve);
            }
        }
        for skill in &self.skill {
            let _ = write!(csv, ",skill_{}", skill.name);
            columns.push(&skill.skill);
        }
        csv.push('\n');
        for row in 0..self.horizon {
            let _ = write!(csv, "{}", row + 1);
            for column in &columns {
                let _ = write!(csv, ",{}", column[row]);
            }
            csv.push('\n');
        }
        csv
    }

    /// The tables for a terminal.
    pub fn tables(&self) -> String {
        let shown: Vec<usize> = SHOWN.into_iter().filter(|&ahead| ahead <= self.horizon).collect();
        let table = |title: &str| {
            let mut table = Table::new();
            table.load_style(UTF8_BORDERS_ONLY);
            let frames = shown.iter().map(|ahead| format!("frame {ahead}"));
            table.set_header(std::iter::once(title.to_owned()).chain(frames));
            table
        };
        let row = |name: &str, curve: &[f64], format: fn(f64) -> String| {
            let cells: Vec<_> = shown.iter().map(|&ahead| format(curve[ahead - 1])).collect();
            std::iter::once(name.to_owned()).chain(cells).collect::<Vec<_>>()
        };
        let scientific: fn(f64) -> String = |x| format!("{x:.2e}");
        let mut text = String::new();
        for (title, quantity) in [
            (
                "position RMSE (domain lengths)",
                (|e| &e.position_rmse) as fn(&MaterialErrors) -> &Vec<f64>,
            ),
            ("velocity RMSE (domain lengths/s)", |e| &e.velocity_rmse),
            ("MinMax MSE", |e| &e.minmax_mse),
        ] {
            let mut rows = table(title);
            for predictor in &self.predictors {
                rows.add_row(row(&predictor.name, quantity(&predictor.all), scientific));
            }
            let _ = writeln!(text, "{rows}");
        }
        let mut rows = table("skill (1 - squared error / best baseline)");
        for skill in &self.skill {
            rows.add_row(row(skill.name, &skill.skill, |x| format!("{x:+.2}")));
        }
        let _ = writeln!(text, "{rows}");
        text
    }
}

fn present(sums: &ErrorSums) -> impl Iterator<Item = Material> {
    Material::ALL.into_iter().filter(|&material| sums.of(material)[0].count > 0.0)
}

fn skills(judgement: &Judgement) -> Vec<MaterialSkill> {
    let mut skills: Vec<_> = present(&judgement.model)
        .map(|material| {
            let model = judgement.model.of(material);
            let baselines: Vec<_> =
                judgement.baselines.iter().map(|(_, sums)| sums.of(material)).collect();
            let skill = (0..model.len())
                .map(|frame| {
                    let best = baselines
                        .iter()
                        .map(|errors| errors[frame].position)
                        .fold(f64::INFINITY, f64::min);
                    1.0 - model[frame].position / best.max(f64::MIN_POSITIVE)
                })
                .collect();
            MaterialSkill { name: material.name(), skill }
        })
        .collect();
    let horizon = skills.first().map_or(0, |s| s.skill.len());
    let mean = (0..horizon)
        .map(|frame| skills.iter().map(|s| s.skill[frame]).sum::<f64>() / skills.len() as f64)
        .collect();
    skills.push(MaterialSkill { name: "mean", skill: mean });
    skills
}
