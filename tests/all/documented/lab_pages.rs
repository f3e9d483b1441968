//! Pages with commands of `eddy-lab`, which its tests follow.

/// How to run on a cluster.
pub const CLUSTER: &str = "docs/src/how-to/cluster.md";
/// How to compare cores.
pub const CORES: &str = "docs/src/how-to/cores.md";
/// How to serve many streams.
pub const STREAMS: &str = "docs/src/how-to/streams.md";
/// How to share streams between nodes.
pub const MANY_ROBOTS: &str = "docs/src/how-to/many_robots.md";
/// Where the numbers come from.
pub const NUMBERS: &str = "docs/src/background/numbers.md";
