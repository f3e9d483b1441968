//! Errors scene by scene: the paper's Tables 2 and 3, and its curves of single scenes (Figs. 4, 8 and 9).

use super::{
    super::{
        Role,
        scenes::{SceneEntry, SceneErrors, last, mean},
    },
    Report, error, error_axis, frames_ahead,
};
use crate::Kind;
use eddy_pages::{Cell, LinePlot, Section, Series, Table};

/// Maximum number of scenes in a table and in a set of plots; `report.json` has all.
const TABLE_SCENES: usize = 12;
const PLOT_SCENES: usize = 6;

/// An error of single scenes: name and accessor.
type Error = (&'static str, fn(&SceneErrors) -> &Vec<f64>);

/// Reduces an error curve to the number in a table.
type Reduce = fn(&[f64]) -> f64;

const ERRORS: [Error; 3] = [
    ("MinMax MSE", |errors| &errors.minmax_mse),
    ("z-score MSE", |errors| &errors.zscore_mse),
    ("position RMSE (domain lengths)", |errors| &errors.position_rmse),
];

impl Report {
    pub(super) fn by_scene(&self, section: &mut Section) {
        let frames = self.paper_frames();
        section.paragraph(&format!(
            "The mean error of frames 1 to {frames} of free rollouts and the error at frame {frames}, averaged over all \
             rollouts of a scene. The lowest error of each row is bold. Tables of this form are in the MinRNN paper; the \
             unit of its MSE is unknown, so only the order of the models can be compared with it."
        ));
        for (title, of_table) in self.paper_tables() {
            if of_table.is_empty() {
                continue;
            }
            section.heading(title);
            let chosen = evenly(&of_table, TABLE_SCENES);
            if chosen.len() < of_table.len() {
                section.paragraph(&format!(
                    "{} of {} scenes, evenly spaced; averages are over all scenes. report.json has all.",
                    chosen.len(),
                    of_table.len()
                ));
            }
            let [first, others @ ..] = ERRORS;
            self.scene_tables(section, &of_table, &chosen, first);
            section.folded("z-score MSE and position RMSE", |inner| {
                for error in others {
                    self.scene_tables(inner, &of_table, &chosen, error);
                }
            });
        }
        section.heading("Error curves of single scenes");
        for (title, of_table) in self.paper_tables() {
            let plots: Vec<LinePlot> = evenly(&of_table, PLOT_SCENES)
                .into_iter()
                .map(|scene| self.scene_plot(scene))
                .collect();
            if !plots.is_empty() {
                section.paragraph(title).plots(&plots);
            }
        }
    }

    /// Scenes of liquid alone, as in Table 2, and the others, as in Table 3.
    fn paper_tables(&self) -> [(&'static str, Vec<&SceneEntry>); 2] {
        let of = |liquid: bool| {
            self.scenes.iter().filter(move |scene| (scene.kind == Kind::Liquid) == liquid).collect()
        };
        [("Scenes of liquid", of(true)), ("Scenes of other materials", of(false))]
    }

    /// Frames ahead in the tables: the paper's twenty, or the horizon if shorter.
    fn paper_frames(&self) -> usize {
        super::super::scenes::SCENE_FRAMES.min(self.horizon)
    }

    /// Indices and names of the predictors in the tables.
    fn columns(&self) -> Vec<(usize, &str)> {
        let all = self.predictors.iter().enumerate();
        all.filter(|(_, entry)| {
            matches!(
                entry.role,
                Role::Model
                    | Role::Recorded
                    | Role::Baseline
                    | Role::Mean
                    | Role::LinearFit
                    | Role::Solver
            )
        })
        .map(|(number, entry)| (number, entry.name.as_str()))
        .collect()
    }

    /// Two tables: the mean over frames, and the last frame.
    fn scene_tables(
        &self,
        section: &mut Section,
        all: &[&SceneEntry],
        chosen: &[&SceneEntry],
        (name, of): Error,
    ) {
        let frames = self.paper_frames();
        let columns = self.columns();
        let blocks: [(String, Reduce); 2] = [
            (format!("{name}, mean of frames 1 to {frames}"), mean),
            (format!("{name} at frame {frames}"), last),
        ];
        for (caption, reduce) in blocks {
            let titles = std::iter::once("scene").chain(columns.iter().map(|(_, name)| *name));
            let mut table = Table::new(caption, titles);
            let numbers = |scene: &SceneEntry| -> Vec<f64> {
                columns.iter().map(|&(number, _)| reduce(of(&scene.errors[number]))).collect()
            };
            for scene in chosen {
                table.row(scene.title(), Cell::lowest_bold(&numbers(scene), error));
            }
            let rows: Vec<Vec<f64>> = all.iter().map(|scene| numbers(scene)).collect();
            let average =
                |column: usize| mean(&rows.iter().map(|row| row[column]).collect::<Vec<_>>());
            let averages: Vec<f64> = (0..columns.len()).map(average).collect();
            table.fixed_row(Cell::bold("Average"), Cell::lowest_bold(&averages, error));
            section.table(&table);
        }
    }

    fn scene_plot(&self, scene: &SceneEntry) -> LinePlot {
        let series = self.columns().into_iter().map(|(number, name)| {
            Series::ahead(name, self.drawn(&scene.errors[number].minmax_mse))
        });
        LinePlot {
            title: scene.title(),
            x: frames_ahead(),
            y: error_axis("MinMax MSE"),
            series: series.collect(),
        }
    }
}

/// At most `count` of the items, evenly spaced.
fn evenly<'a, T>(all: &[&'a T], count: usize) -> Vec<&'a T> {
    let count = all.len().min(count);
    (0..count).map(|k| all[k * all.len() / count]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chosen_items_are_evenly_spaced() {
        let numbers: Vec<usize> = (0..10).collect();
        let all: Vec<&usize> = numbers.iter().collect();
        assert_eq!(evenly(&all, 4), [&0, &2, &5, &7]);
        assert_eq!(evenly(&all, 40).len(), 10);
        assert!(evenly::<usize>(&[], 3).is_empty());
    }
}
