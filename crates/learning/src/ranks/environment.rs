//! Which process of a run this is, from what torchrun and Slurm put into the environment.

use std::str::FromStr;

use super::RankError;

/// Port of torchrun where it names none.
const DEFAULT_PORT: u16 = 29_500;
/// First port of Slurm's jobs, which name none; the last digits of the job's number follow.
const SLURM_PORT: u16 = 20_000;

/// The place of this process among those that train together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Process {
    /// Its number, from 0.
    pub rank: usize,
    /// How many there are.
    pub count: usize,
    /// Its number on its host, from 0.
    pub local_rank: usize,
    /// The host of rank 0.
    pub address: String,
    /// The port of rank 0: the one above `MASTER_PORT`, which belongs to torchrun.
    pub port: u16,
    /// The variable that says how many there are.
    pub count_variable: &'static str,
}

impl Process {
    /// From the environment; `None` where neither torchrun nor Slurm started several processes.
    ///
    /// # Errors
    /// [`RankError::Variable`].
    #[expect(clippy::disallowed_methods, reason = "torchrun and Slurm say it in the environment")]
    pub fn from_environment() -> Result<Option<Self>, RankError> {
        Self::parse(&|name| std::env::var(name).ok())
    }

    /// As [`Self::from_environment`], with the variables that `variable` knows.
    ///
    /// # Errors
    /// [`RankError::Variable`].
    pub fn parse(variable: &dyn Fn(&str) -> Option<String>) -> Result<Option<Self>, RankError> {
        let is_set = |name: &&str| variable(name).is_some();
        if let Some(set) = ["RANK", "WORLD_SIZE", "LOCAL_RANK"].iter().find(|&name| is_set(name)) {
            return Self::of_torchrun(variable, set).map(Some);
        }
        match (variable("SLURM_PROCID"), variable("SLURM_NTASKS")) {
            (Some(_), Some(_)) => Self::of_slurm(variable),
            _ => Ok(None),
        }
    }

    fn of_torchrun(
        variable: &dyn Fn(&str) -> Option<String>,
        set: &str,
    ) -> Result<Self, RankError> {
        let why = format!("since {set} is set (by torchrun)");
        let count = number(variable, "WORLD_SIZE", &format!("the number of processes, {why}"))?;
        let rank = number(variable, "RANK", &format!("the number of this process, {why}"))?;
        let local = format!("the number of this process on its host, {why}");
        let local_rank = number(variable, "LOCAL_RANK", &local)?;
        check_rank("RANK", rank, "WORLD_SIZE", count)?;
        check_rank("LOCAL_RANK", local_rank, "WORLD_SIZE", count)?;
        let address = match variable("MASTER_ADDR") {
            Some(address) => address,
            None if count <= 1 => "localhost".to_owned(),
            None => {
                let expected = format!("the host of rank 0, {why}");
                return Err(wrong("MASTER_ADDR", None, expected));
            }
        };
        let port = port(variable, DEFAULT_PORT)?;
        Ok(Self { rank, count, local_rank, address, port, count_variable: "WORLD_SIZE" })
    }

    fn of_slurm(variable: &dyn Fn(&str) -> Option<String>) -> Result<Option<Self>, RankError> {
        const WHY: &str = "since SLURM_PROCID and SLURM_NTASKS are set (by srun)";
        let count = number(variable, "SLURM_NTASKS", "the number of tasks")?;
        if count <= 1 {
            return Ok(None);
        }
        let rank = number(variable, "SLURM_PROCID", "the number of this task")?;
        let local = format!("the number of this task on its host, {WHY}");
        let local_rank = number(variable, "SLURM_LOCALID", &local)?;
        check_rank("SLURM_PROCID", rank, "SLURM_NTASKS", count)?;
        check_rank("SLURM_LOCALID", local_rank, "SLURM_NTASKS", count)?;
        let nodes = ["SLURM_STEP_NODELIST", "SLURM_JOB_NODELIST"].into_iter().find_map(variable);
        let address = match (variable("MASTER_ADDR"), nodes) {
            (Some(address), _) => address,
            (None, Some(nodes)) if is_one_host(&nodes) => "localhost".to_owned(),
            // Tasks are numbered from the first host on.
            (None, Some(nodes)) => first_host(&nodes),
            (None, None) => {
                let expected = format!("the host of task 0, or SLURM_JOB_NODELIST, {WHY}");
                return Err(wrong("MASTER_ADDR", None, expected));
            }
        };
        let job = variable("SLURM_JOB_ID").and_then(|job| job.parse::<u64>().ok()).unwrap_or(0);
        let port = port(variable, SLURM_PORT + (job % 10_000) as u16)?;
        let count_variable = "SLURM_NTASKS";
        Ok(Some(Self { rank, count, local_rank, address, port, count_variable }))
    }

    /// Whether this process decides for all, and writes the files.
    pub fn leads(&self) -> bool {
        self.rank == 0
    }
}

fn wrong(name: &'static str, found: Option<String>, expected: String) -> RankError {
    let found = found.unwrap_or_else(|| "nothing".to_owned());
    RankError::Variable { name, found, expected }
}

fn number<T: FromStr>(
    variable: &dyn Fn(&str) -> Option<String>,
    name: &'static str,
    expected: &str,
) -> Result<T, RankError> {
    let found = variable(name);
    let number = found.as_ref().and_then(|text| text.trim().parse().ok());
    number.ok_or_else(|| wrong(name, found, expected.to_owned()))
}

/// Rejects a rank that is not below the number of processes.
fn check_rank(
    name: &'static str,
    rank: usize,
    count_name: &str,
    count: usize,
) -> Result<(), RankError> {
    if rank < count {
        return Ok(());
    }
    Err(wrong(name, Some(rank.to_string()), format!("a number below {count_name}, {count}")))
}

/// The port above `MASTER_PORT`, which torchrun itself uses.
fn port(variable: &dyn Fn(&str) -> Option<String>, default: u16) -> Result<u16, RankError> {
    let expected = "a port from 1 to 65534";
    let port = match variable("MASTER_PORT") {
        None => default,
        Some(_) => number(variable, "MASTER_PORT", expected)?,
    };
    match port {
        0 | u16::MAX => Err(wrong("MASTER_PORT", Some(port.to_string()), expected.to_owned())),
        port => Ok(port + 1),
    }
}

/// Whether a list of Slurm names a single host.
fn is_one_host(nodes: &str) -> bool {
    !nodes.contains([',', '['])
}

/// The first host of a list of Slurm, such as `gpu[03-05,9],login`.
fn first_host(nodes: &str) -> String {
    let head = nodes.split([',', '[']).next().unwrap_or_default();
    let Some(numbers) = nodes[head.len()..].strip_prefix('[') else { return head.to_owned() };
    let first = numbers.split([',', '-', ']']).next().unwrap_or_default();
    let rest = numbers.split_once(']').map_or("", |(_, rest)| rest);
    let end = rest.split(',').next().unwrap_or_default();
    format!("{head}{first}{end}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(variables: &[(&str, &str)]) -> Result<Option<Process>, String> {
        let known = |name: &str| {
            variables.iter().find(|(known, _)| *known == name).map(|(_, text)| (*text).to_owned())
        };
        Process::parse(&known).map_err(|error| error.to_string())
    }

    const TORCHRUN: [(&str, &str); 5] = [
        ("RANK", "3"),
        ("WORLD_SIZE", "4"),
        ("LOCAL_RANK", "1"),
        ("MASTER_ADDR", "node1"),
        ("MASTER_PORT", "1234"),
    ];

    const SLURM: [(&str, &str); 5] = [
        ("SLURM_PROCID", "2"),
        ("SLURM_NTASKS", "4"),
        ("SLURM_LOCALID", "0"),
        ("SLURM_JOB_NODELIST", "gpu[07-08,12]-x,login"),
        ("SLURM_JOB_ID", "1230042"),
    ];

    fn with<'a>(
        variables: &[(&'a str, &'a str)],
        name: &'a str,
        text: &'a str,
    ) -> Vec<(&'a str, &'a str)> {
        let others = variables.iter().copied().filter(|(known, _)| *known != name);
        others.chain([(name, text)]).collect()
    }

    fn without<'a>(variables: &[(&'a str, &'a str)], name: &str) -> Vec<(&'a str, &'a str)> {
        variables.iter().copied().filter(|(known, _)| *known != name).collect()
    }

    #[test]
    fn torchrun_says_which_process_this_is() {
        let process = parse(&TORCHRUN).unwrap().unwrap();
        let expected = Process {
            rank: 3,
            count: 4,
            local_rank: 1,
            address: "node1".to_owned(),
            port: 1235,
            count_variable: "WORLD_SIZE",
        };
        assert_eq!(process, expected);
        let default = parse(&without(&TORCHRUN, "MASTER_PORT")).unwrap().unwrap();
        assert_eq!(default.port, 29_501);
    }

    #[test]
    fn slurm_says_which_process_this_is() {
        let process = parse(&SLURM).unwrap().unwrap();
        assert_eq!((process.rank, process.count, process.local_rank), (2, 4, 0));
        assert_eq!((process.address.as_str(), process.port), ("gpu07-x", 20_043));
        let step = with(&SLURM, "SLURM_STEP_NODELIST", "gpu08-x");
        assert_eq!(parse(&step).unwrap().unwrap().address, "localhost", "a step on one host");
        let named = with(&SLURM, "MASTER_ADDR", "10.0.0.1");
        assert_eq!(parse(&named).unwrap().unwrap().address, "10.0.0.1");
    }

    #[test]
    fn a_process_is_alone_where_nobody_says_otherwise() {
        assert_eq!(parse(&[]), Ok(None));
        assert_eq!(parse(&[("MASTER_ADDR", "node1")]), Ok(None));
        assert_eq!(parse(&with(&SLURM, "SLURM_NTASKS", "1")), Ok(None));
        assert_eq!(parse(&without(&SLURM, "SLURM_NTASKS")), Ok(None), "a job without -n");
    }

    #[test]
    fn a_wrong_variable_is_named_with_what_is_expected() {
        let cases = [
            (
                without(&TORCHRUN, "WORLD_SIZE"),
                "WORLD_SIZE: found nothing, expected the number of processes, since RANK is set (by torchrun)",
            ),
            (
                without(&TORCHRUN, "RANK"),
                "RANK: found nothing, expected the number of this process, since WORLD_SIZE is set (by torchrun)",
            ),
            (
                without(&TORCHRUN, "LOCAL_RANK"),
                "LOCAL_RANK: found nothing, expected the number of this process on its host, since RANK is set (by torchrun)",
            ),
            (
                without(&TORCHRUN, "MASTER_ADDR"),
                "MASTER_ADDR: found nothing, expected the host of rank 0, since RANK is set (by torchrun)",
            ),
            (with(&TORCHRUN, "RANK", "4"), "RANK: found 4, expected a number below WORLD_SIZE, 4"),
            (
                with(&TORCHRUN, "RANK", "one"),
                "RANK: found one, expected the number of this process, since RANK is set (by torchrun)",
            ),
            (
                with(&TORCHRUN, "MASTER_PORT", "65535"),
                "MASTER_PORT: found 65535, expected a port from 1 to 65534",
            ),
            (
                with(&TORCHRUN, "MASTER_PORT", "http"),
                "MASTER_PORT: found http, expected a port from 1 to 65534",
            ),
            (
                without(&SLURM, "SLURM_LOCALID"),
                "SLURM_LOCALID: found nothing, expected the number of this task on its host, since SLURM_PROCID and SLURM_NTASKS are set (by srun)",
            ),
            (
                without(&SLURM, "SLURM_JOB_NODELIST"),
                "MASTER_ADDR: found nothing, expected the host of task 0, or SLURM_JOB_NODELIST, since SLURM_PROCID and SLURM_NTASKS are set (by srun)",
            ),
        ];
        for (variables, expected) in cases {
            assert_eq!(parse(&variables), Err(expected.to_owned()), "{variables:?}");
        }
    }

    #[test]
    fn the_first_host_of_a_list_is_found() {
        let cases = [
            ("gpu1", "gpu1"),
            ("gpu1,gpu2", "gpu1"),
            ("gpu[3-5]", "gpu3"),
            ("gpu[03,7]-ib,gpu9", "gpu03-ib"),
            ("a[1-2],b", "a1"),
        ];
        for (list, expected) in cases {
            assert_eq!(first_host(list), expected, "{list}");
        }
    }
}
