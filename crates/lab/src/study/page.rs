//! The report of a comparison: a page, and its tables as Markdown.

use super::{
    Comparison, Curve, Networks, Speed, StudyConfig,
    networks::{mean, scientific, spread},
};
use crate::bench::training::{CORES, Timing, milliseconds};
use eddy_inference::checkpoint::{Activation, Core};
use eddy_learning::train::step_benchmark::{GPU_CORE_PARTICLES, Part};
use eddy_pages::{Axis, LinePlot, Page, Provenance, Table};

/// Builds the report of a study.
pub struct StudyReport {
    page: Page,
    tables: Vec<(String, Table)>,
}

impl StudyReport {
    /// The title and introduction.
    pub fn new(comparison: Comparison, study: &StudyConfig) -> Self {
        let title = match comparison {
            Comparison::Cores => "Five cores of the frame model",
            Comparison::Activations => "Activations",
            Comparison::Loss => "With and without the density loss",
            Comparison::Window => "Number of observed frames",
            Comparison::Output => "What the network predicts",
            Comparison::Scenes => "Scenes to train on",
        };
        let warning = study.warning(comparison).map_or(String::new(), |warning| warning + " ");
        let sets = comparison.data_sets(study);
        let test_set = sets.iter().find_map(|set| comparison.test_set(study, set));
        let test = test_set.map_or_else(
            || "the rest for the test".to_owned(),
            |set| format!("the test has {} other scenes of seed {}", set.scenes.scenes, set.seed),
        );
        let list = |words: Vec<String>| words.join(", ");
        let lead = format!(
            "{warning}Scenes of seed {}, their number in the name: {}. The first 80 % of each data set for training, the next 10 % \
             for validation; {test}. Seeds of the networks: {}.",
            study.data.seed,
            list(sets.iter().map(|set| set.name.clone()).collect()),
            list(study.seeds.iter().map(u64::to_string).collect()),
        );
        Self { page: Page::new(title, lead), tables: Vec::new() }
    }

    /// Adds the networks of a data set.
    pub fn networks(&mut self, set: &str, study: &StudyConfig, networks: &Networks) {
        let windows = &study.training.windows;
        let budget = format!(
            "Each network was trained for at most {} steps of Adam with {} windows each.",
            study.training.batches() * study.training.epochs as usize,
            windows.batch,
        );
        let [errors, ends] = networks.by_scenes();
        let tables = [
            networks.summary(),
            networks.skills(),
            networks.ratios(),
            errors,
            ends,
            networks.training(),
        ];
        let section = self.page.section(set.to_owned());
        section.paragraph(&budget);
        section.plots(&networks.plots());
        tables.iter().for_each(|table| _ = section.table(table));
        section.paragraph(
            "Before a rollout, a network observes as many frames as in its training windows; in the column that says so, all \
             frames of the stream, as in a node. Errors are mean squared errors of x, y, vx, vy, each divided by its range in the training part. Skill is 1 - \
             squared position error / squared position error of the best trivial predictor (persistence, constant velocity, \
             ballistic). Intervals are 95 % percentile bootstrap intervals: 1,000 resamples of scenes and seeds; with \
             fewer than five scenes there is none.",
        );
        self.tables.extend(tables.into_iter().map(|table| (set.to_owned(), table)));
    }

    /// Adds the learning curves of a data set.
    #[expect(clippy::too_many_lines, reason = "the parts of one plot, one after another")]
    pub fn curves(&mut self, set: &str, study: &StudyConfig, curves: &[Curve]) {
        let dense = &study.dense;
        let about = format!(
            "A dense network of {} layers of {} and an output layer predicts the next frame's x, y, vx, vy of all \
             particles from one frame's; {} epochs of {} pairs, {} a batch, Adam at {}.",
            dense.layers,
            dense.width,
            dense.epochs,
            dense.per_epoch,
            dense.batch,
            dense.learning_rate
        );
        let of = |activation: Activation| -> Vec<&Curve> {
            curves.iter().filter(|curve| curve.activation == activation).collect()
        };
        let mut table = Table::new(
            "MinMax MSE of the next frame after the last epoch: mean over seeds",
            ["", "training", "validation", "lowest to highest", "best validation"],
        );
        for &activation in &study.activations {
            let ends: Vec<_> =
                of(activation).iter().filter_map(|c| c.curve.epochs.last().copied()).collect();
            let validation: Vec<f64> = ends.iter().map(|end| end.validation_loss).collect();
            let [lowest, highest] = super::networks::extremes(&validation);
            let best = of(activation).into_iter().map(|curve| {
                let losses = curve.curve.epochs.iter().map(|epoch| epoch.validation_loss);
                losses.fold(f64::INFINITY, f64::min)
            });
            let cells = [
                scientific(mean(ends.iter().map(|end| end.training_loss))),
                scientific(mean(validation.iter().copied())),
                format!("{} to {}", scientific(lowest), scientific(highest)),
                scientific(mean(best)),
            ];
            table.row(activation.name(), cells);
        }
        if let Some(Curve { curve, .. }) = curves.first() {
            let row =
                |loss: f64| ["-".to_owned(), scientific(loss), "-".to_owned(), "-".to_owned()];
            table.row("next frame = this frame", row(curve.persistence));
            table.row("mean of the training", row(curve.mean));
        }
        let plot = |title: &str, loss: fn(&Curve) -> Vec<f64>| LinePlot {
            title: title.to_owned(),
            x: Axis::linear("epoch"),
            y: Axis::logarithmic("MinMax MSE"),
            series: study
                .activations
                .iter()
                .map(|&activation| {
                    let curves: Vec<Vec<f64>> = of(activation).into_iter().map(loss).collect();
                    spread(activation.name(), &curves)
                })
                .collect(),
        };
        let plots = [
            plot("Training", |c| c.curve.epochs.iter().map(|e| e.training_loss).collect()),
            plot("Validation", |c| c.curve.epochs.iter().map(|e| e.validation_loss).collect()),
        ];
        let section = self.page.section(set.to_owned());
        section.paragraph(&about).plots(&plots).table(&table);
        self.tables.push((set.to_owned(), table));
    }

    /// Adds the times of training steps.
    pub fn speed(&mut self, speed: &Speed) {
        let mut lengths: Vec<(Part, usize)> =
            speed.steps.iter().map(|step| (step.what, step.frames)).collect();
        lengths.dedup();
        let time = |core: Core, (part, frames): (Part, usize)| {
            let same = |step: &&Timing| (step.core, step.what, step.frames) == (core, part, frames);
            speed.steps.iter().find(same).map_or(f64::NAN, |step| step.milliseconds)
        };
        let title = |&(part, frames): &(Part, usize)| {
            let part = if part == Part::Frame { "network" } else { "core" };
            format!("{part}, T = {frames}")
        };
        let windows = speed.steps.first().map_or(0, |step| step.windows);
        let mut table = Table::new(
            format!("Time per training step of {windows} windows (ms), by frames per window"),
            std::iter::once(String::new()).chain(lengths.iter().map(title)),
        );
        for core in CORES {
            let cells = lengths.iter().map(|&length| milliseconds(time(core, length)));
            table.row(core.name(), cells.collect::<Vec<_>>());
        }
        for [slow, fast] in [[Core::Lstm, Core::MinLstm], [Core::Gru, Core::MinGru]] {
            let ratio =
                |&length: &(Part, usize)| format!("{:.2}", time(slow, length) / time(fast, length));
            let cells: Vec<String> = lengths.iter().map(ratio).collect();
            table.row(format!("{} / {}", slow.name(), fast.name()), cells);
        }
        let device = match speed.precision.as_str() {
            "" => speed.device.name().to_owned(),
            precision => format!(
                "{}, {precision}, the core alone with {GPU_CORE_PARTICLES} particles",
                speed.device.name()
            ),
        };
        let section = self.page.section("Training speed");
        section.table(&table).paragraph(&format!(
            "The paper's Table 4, by window length; on {} cores of {}, device {}.",
            speed.machine.cores, speed.machine.processor, device
        ));
        self.tables.push(("Training speed".to_owned(), table));
    }

    /// The finished page, with the equivalent commands.
    pub fn page(mut self, made: &Provenance, commands: &[String]) -> Page {
        let section = self.page.section("Reproduce");
        section.provenance(made);
        section.folded("Equivalent commands", |section| {
            section.code(&commands.join("\n"));
        });
        self.page
    }

    /// The tables as Markdown, under their headings.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        let mut heading = "";
        for (of, table) in &self.tables {
            if of != heading {
                text.push_str(&format!("## {of}\n\n"));
                heading = of;
            }
            text.push_str(&format!("{}\n", table.markdown()));
        }
        text
    }

    /// The first table under each heading, for a terminal.
    pub fn summaries(&self) -> impl Iterator<Item = (&str, &Table)> {
        let mut last = "";
        self.tables.iter().filter_map(move |(of, table)| {
            let first = of != last;
            last = of;
            first.then_some((of.as_str(), table))
        })
    }
}
