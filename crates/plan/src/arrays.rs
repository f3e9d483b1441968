//! Tasks that can run at the same time, as job arrays of batch systems.

use super::{Cost, Job, OpenPlan, TaskState};

/// Most tasks of an array: Slurm's default for `MaxArraySize` is 1001.
const MOST_TASKS: usize = 1000;

/// Tasks of one kind that do not need each other, and have the same needs.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// The kind of its tasks.
    pub kind: &'static str,
    /// Number of the first task.
    pub first: usize,
    /// Its tasks, relative to the first, for example `0-3,7`.
    pub indices: String,
    /// Number of its tasks.
    pub tasks: usize,
    /// Positions, in the list of arrays, of those that must be done before.
    pub after: Vec<usize>,
    /// The largest cost of a task.
    pub cost: Cost,
}

impl<J: Job> OpenPlan<J> {
    /// The tasks that are not done as arrays. An array comes after those that it needs.
    pub fn arrays(&self, states: &[TaskState]) -> Vec<Array> {
        let tasks = &self.plan.tasks;
        let is_done = |number: usize| matches!(states[number], TaskState::Done { .. });
        // The longest chain of tasks before each.
        let mut depth: Vec<usize> = Vec::new();
        for before in &self.before {
            depth.push(before.iter().map(|&before| depth[before] + 1).max().unwrap_or(0));
        }
        let key = |number: usize| {
            let Cost { cores, gpus, .. } = tasks[number].cost;
            (depth[number], self.plan.job.kind(&tasks[number].work), cores, gpus)
        };
        let mut groups: Vec<Vec<usize>> = Vec::new();
        for number in (0..tasks.len()).filter(|&number| !is_done(number)) {
            let fits = |group: &&mut Vec<usize>| {
                key(group[0]) == key(number) && number - group[0] < MOST_TASKS
            };
            match groups.iter_mut().find(fits) {
                Some(group) => group.push(number),
                None => groups.push(vec![number]),
            }
        }
        groups.sort_by_key(|group| (depth[group[0]], group[0]));
        let group_of = |number: usize| groups.iter().position(|group| group.contains(&number));
        let array = |group: &Vec<usize>| {
            let before = group.iter().flat_map(|&number| &self.before[number]);
            let mut after: Vec<usize> = before.filter_map(|&number| group_of(number)).collect();
            after.sort_unstable();
            after.dedup();
            let costs = || group.iter().map(|&number| tasks[number].cost);
            let cost = Cost {
                seconds: costs().map(|cost| cost.seconds).fold(0.0, f64::max),
                memory: costs().map(|cost| cost.memory).max().unwrap_or(0),
                ..tasks[group[0]].cost
            };
            let kind = self.plan.job.kind(&tasks[group[0]].work);
            let first = group[0];
            let indices: Vec<usize> = group.iter().map(|number| number - first).collect();
            Array { kind, first, indices: ranges(&indices), tasks: group.len(), after, cost }
        };
        groups.iter().map(array).collect()
    }
}

/// Ascending numbers as ranges: `0-3,7`.
fn ranges(numbers: &[usize]) -> String {
    let mut ranges: Vec<(usize, usize)> = Vec::new();
    for &number in numbers {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => ranges.push((number, number)),
        }
    }
    let shown = |&(first, last): &(usize, usize)| match first == last {
        true => first.to_string(),
        false => format!("{first}-{last}"),
    };
    ranges.iter().map(shown).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::ranges;

    #[test]
    fn numbers_are_shown_as_ranges() {
        assert_eq!(ranges(&[0, 1, 2, 3, 7, 9, 10]), "0-3,7,9-10");
        assert_eq!(ranges(&[5]), "5");
    }
}
