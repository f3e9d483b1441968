//! The file of a plan.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Component, Path, PathBuf},
};

use eddy_frames::progress::Progress;
use eddy_settings::{atomic, near};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};

use super::{PlanError, state::State};

/// Version of the format.
const FORMAT: u32 = 1;
/// Version of the program: another one may compute other bits.
const EDDY: &str = env!("CARGO_PKG_VERSION");

/// A long job whose parts are tasks of a plan.
pub trait Job: Serialize + DeserializeOwned + Sync {
    /// What a single task does.
    type Work: Serialize + DeserializeOwned + Sync;

    /// The kind of a task, in one word.
    fn kind(&self, work: &Self::Work) -> &'static str;

    /// Does the work of a task and returns a message, or `None` if it was cancelled. Outputs appear whole or not at all,
    /// also when the process is killed. May be called again for work that is done.
    ///
    /// # Errors
    /// Why the work cannot be done.
    fn run(&self, work: &Self::Work, progress: &dyn Progress) -> anyhow::Result<Option<String>>;
}

/// What a task needs of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cost {
    /// Estimated time (s).
    pub seconds: f64,
    /// Processor cores that it can use.
    pub cores: u32,
    /// Estimated memory (MiB).
    pub memory: u64,
    /// GPUs that it needs.
    pub gpus: u32,
}

/// A task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Task<W> {
    /// Its name: words of letters, digits, `.`, `_` and `-`, separated by `/`.
    pub name: String,
    /// What it does.
    pub work: W,
    /// Files and folders that must exist before it starts.
    pub inputs: Vec<PathBuf>,
    /// Files and folders that it writes.
    pub outputs: Vec<PathBuf>,
    /// What it needs of a machine.
    pub cost: Cost,
}

/// The tasks of a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, bound = "")]
pub struct Plan<J: Job> {
    /// Version of the format.
    format: u32,
    /// Version of the program that has written it, and runs it.
    eddy: String,
    /// Where the paths of the plan start, relative to the folder of the file.
    directory: PathBuf,
    /// The job.
    pub job: J,
    /// Its tasks. A task comes after those whose outputs it reads.
    pub tasks: Vec<Task<J::Work>>,
}

impl<J: Job> Plan<J> {
    /// A plan of this version.
    pub fn new(job: J, tasks: Vec<Task<J::Work>>) -> Self {
        Self { format: FORMAT, eddy: EDDY.to_owned(), directory: PathBuf::from("."), job, tasks }
    }

    /// Lets the paths start in a folder: relative to the file if it is within that folder, so that both can be moved
    /// together, or are mounted elsewhere on other machines. Both paths are absolute.
    #[must_use]
    pub fn starting_in(mut self, folder: &Path, file: &Path) -> Self {
        let inside = file.parent().and_then(|parent| parent.strip_prefix(folder).ok());
        self.directory = match inside {
            Some(inside) if inside.as_os_str().is_empty() => PathBuf::from("."),
            Some(inside) => inside.components().map(|_| Component::ParentDir).collect(),
            None => folder.to_owned(),
        };
        self
    }

    /// Writes the file.
    ///
    /// # Errors
    /// [`PlanError::Io`], [`PlanError::NoPlan`] when a path is not UTF-8.
    pub fn save(&self, file: &Path) -> Result<(), PlanError> {
        let text = self.text();
        let text = text.map_err(|reason| PlanError::NoPlan { file: file.to_owned(), reason })?;
        atomic::replace(file, text.as_bytes()).map_err(PlanError::io("write", file))
    }

    /// JSON with one line per task, for readability.
    fn text(&self) -> serde_json::Result<String> {
        let tasks: Vec<String> =
            self.tasks.iter().map(serde_json::to_string).collect::<serde_json::Result<_>>()?;
        Ok(format!(
            "{{\n\"format\": {},\n\"eddy\": {},\n\"directory\": {},\n\"job\": {},\n\"tasks\": [\n{}\n]\n}}\n",
            self.format,
            serde_json::to_string(&self.eddy)?,
            serde_json::to_string(&self.directory)?,
            serde_json::to_string(&self.job)?,
            tasks.join(",\n")
        ))
    }
}

/// A plan in its file, with the states of its tasks.
pub struct OpenPlan<J: Job> {
    pub(crate) file: PathBuf,
    pub(crate) plan: Plan<J>,
    pub(crate) state: State,
    /// For each task, those that write its inputs.
    pub(crate) before: Vec<Vec<usize>>,
}

impl<J: Job> OpenPlan<J> {
    /// Reads a plan.
    ///
    /// # Errors
    /// [`PlanError::Io`], [`PlanError::NoPlan`], [`PlanError::Invalid`]: also for a plan of another version.
    pub fn read(file: &Path) -> Result<Self, PlanError> {
        let text = fs::read_to_string(file).map_err(|reason| near::in_folder(file, reason));
        let text = text.map_err(PlanError::io("read", file))?;
        let invalid = |reason| PlanError::NoPlan { file: file.to_owned(), reason };
        // Before all else: other versions may have other fields.
        let Versions { format, eddy } = serde_json::from_str(&text).map_err(invalid)?;
        check_version(
            file,
            "format",
            format.map(|format| format.to_string()),
            &FORMAT.to_string(),
        )?;
        check_version(file, "eddy", eddy, EDDY)?;
        let plan: Plan<J> = serde_json::from_str(&text).map_err(invalid)?;
        let before = before(file, &plan.tasks)?;
        let digest = format!("{:x}", Sha256::digest(text.as_bytes()));
        let state = State::new(file.with_extension("state"), digest);
        Ok(Self { file: file.to_owned(), plan, state, before })
    }

    /// The job.
    pub fn job(&self) -> &J {
        &self.plan.job
    }

    /// Its tasks.
    pub fn tasks(&self) -> &[Task<J::Work>] {
        &self.plan.tasks
    }

    /// The tasks that write the inputs of a task, by their numbers.
    pub fn before(&self, number: usize) -> &[usize] {
        &self.before[number]
    }

    /// The folder in which the paths of the plan start.
    ///
    /// # Errors
    /// [`PlanError::Invalid`] if it does not exist.
    pub fn directory(&self) -> Result<PathBuf, PlanError> {
        let here = self.file.parent().unwrap_or(Path::new(""));
        let folder = here.join(&self.plan.directory);
        match fs::canonicalize(&folder) {
            Ok(folder) => Ok(folder),
            Err(reason) => Err(PlanError::Invalid {
                file: self.file.clone(),
                field: "directory".to_owned(),
                found: format!("{} ({reason})", folder.display()),
                expected: "the folder in which the plan was written".to_owned(),
            }),
        }
    }

    /// The number of a task, of which `word` is the number or the name.
    ///
    /// # Errors
    /// [`PlanError::NoTask`].
    pub fn find(&self, word: &str) -> Result<usize, PlanError> {
        let names = || self.plan.tasks.iter().map(|task| task.name.as_str());
        let number = word.parse().ok().filter(|number| *number < self.plan.tasks.len());
        number.or_else(|| names().position(|name| name == word)).ok_or_else(|| PlanError::NoTask {
            file: self.file.clone(),
            found: word.to_owned(),
            tasks: self.plan.tasks.len(),
            hint: near::hint(word, names()),
        })
    }

    /// Number and name of a task, for messages.
    pub(crate) fn label(&self, number: usize) -> String {
        format!("task {number}, {}", self.plan.tasks[number].name)
    }
}

/// What all versions of the format have.
#[derive(Deserialize)]
struct Versions {
    format: Option<u32>,
    eddy: Option<String>,
}

fn check_version(
    file: &Path,
    field: &str,
    found: Option<String>,
    expected: &str,
) -> Result<(), PlanError> {
    if found.as_deref() == Some(expected) {
        return Ok(());
    }
    let found = found.unwrap_or_else(|| "nothing".to_owned());
    let expected = format!("{expected}: a plan is run by the version of eddy that has written it");
    Err(PlanError::Invalid { file: file.to_owned(), field: field.to_owned(), found, expected })
}

/// The tasks that write the inputs of each task. Names and outputs differ, and no task comes before one whose outputs it reads.
fn before<W>(file: &Path, tasks: &[Task<W>]) -> Result<Vec<Vec<usize>>, PlanError> {
    let invalid = |number: usize, field: &str, found: &str, expected: &str| PlanError::Invalid {
        file: file.to_owned(),
        field: format!("tasks[{number}].{field}"),
        found: found.to_owned(),
        expected: expected.to_owned(),
    };
    let mut names = BTreeSet::new();
    let mut writers: BTreeMap<&Path, usize> = BTreeMap::new();
    for (number, task) in tasks.iter().enumerate() {
        if !is_name(&task.name) {
            let expected = "words of letters, digits, `.`, `_` and `-`, separated by `/`";
            return Err(invalid(number, "name", &task.name, expected));
        }
        if !names.insert(&task.name) {
            return Err(invalid(number, "name", &task.name, "a name that no other task has"));
        }
        for output in &task.outputs {
            if writers.insert(output, number).is_some() {
                let found = output.display().to_string();
                return Err(invalid(number, "outputs", &found, "paths that no other task writes"));
            }
        }
    }
    let mut all = Vec::new();
    for (number, task) in tasks.iter().enumerate() {
        let mut before = BTreeSet::new();
        for input in &task.inputs {
            let Some(&writer) = writers.get(input.as_path()) else { continue };
            if writer >= number {
                let found = format!("{}, an output of tasks[{writer}]", input.display());
                return Err(invalid(number, "inputs", &found, "outputs of earlier tasks"));
            }
            before.insert(writer);
        }
        all.push(before.into_iter().collect());
    }
    Ok(all)
}

/// Whether a name is also that of a file.
fn is_name(name: &str) -> bool {
    let is_word = |word: &str| {
        let known = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        !word.is_empty() && !word.starts_with('.') && word.chars().all(known)
    };
    name.split('/').all(is_word)
}
