//! The files of a report.

use std::{
    fmt::Write as _,
    fs, io,
    path::{Path, PathBuf},
};

use super::{Entry, Report, curves::Curves, curves::StepCurves};
use eddy_pages::picture::write_png;
use eddy_settings::atomic;

pub(super) const JSON: &str = "report.json";
const CSV: &str = "curves.csv";
pub(super) const HTML: &str = "report.html";
const PLOT: &str = "cost_error.png";

const COLUMNS: &str = "predictor,kind,frame,position_rmse,velocity_rmse,minmax_mse,zscore_mse,skill,one_step_rmse,cumulated_rmse";

impl Report {
    /// The file in the folder of a report that [`Report::save`] writes last.
    pub fn file(folder: &Path) -> PathBuf {
        folder.join(JSON)
    }

    /// Writes `report.json`, `report.html`, `curves.csv` and, if times were measured, `cost_error.png` into `folder`, which
    /// is created if needed.
    ///
    /// # Errors
    /// I/O errors.
    pub fn save(&self, folder: &Path) -> io::Result<()> {
        fs::create_dir_all(folder)?;
        self.page()?.save(&folder.join(HTML))?;
        fs::write(folder.join(CSV), self.curves())?;
        let plot = folder.join(PLOT);
        if fs::exists(&plot)? {
            fs::remove_file(&plot)?;
        }
        if let Some(canvas) = self.cost_plot().canvas() {
            write_png(&plot, &canvas).map_err(io::Error::other)?;
        }
        // The last one and whole: where it is, the others are.
        let json = serde_json::to_string_pretty(self).map_err(io::Error::other)?;
        atomic::replace(&folder.join(JSON), (json + "\n").as_bytes())
    }

    /// All curves as CSV, one row per predictor, kind (or `all`) and frame ahead. Missing numbers are empty.
    fn curves(&self) -> String {
        let mut csv = COLUMNS.to_owned() + "\n";
        for entry in &self.predictors {
            let Entry { name, curves, skill, steps, kinds, .. } = entry;
            add(&mut csv, [name, "all"], curves, skill, steps.as_ref());
            for kind in kinds {
                let names = [name, kind.kind.name()];
                add(&mut csv, names, &kind.curves, &kind.skill, kind.steps.as_ref());
            }
        }
        csv
    }
}

fn add(
    csv: &mut String,
    [predictor, kind]: [&str; 2],
    curves: &Curves,
    skill: &[f64],
    steps: Option<&StepCurves>,
) {
    let quoted = predictor.replace('"', "\"\"");
    for (frame, &skill) in skill.iter().enumerate() {
        let _ = write!(csv, "\"{quoted}\",{kind},{}", frame + 1);
        for number in [
            Some(curves.position_rmse[frame]),
            Some(curves.velocity_rmse[frame]),
            Some(curves.minmax_mse[frame]),
            Some(curves.zscore_mse[frame]),
            Some(skill),
            steps.map(|steps| steps.one_step_rmse[frame]),
            steps.map(|steps| steps.cumulated_rmse[frame]),
        ] {
            match number.filter(|number| number.is_finite()) {
                Some(number) => _ = write!(csv, ",{number}"),
                None => csv.push(','),
            }
        }
        csv.push('\n');
    }
}
