//! Pairs frames of particles with poses of tools, by their stamps.

use std::{
    collections::{BTreeSet, VecDeque},
    fmt,
    time::Duration,
};

use eddy_frames::{
    Stamp,
    tool::{InvalidTool, Pose, Tool, ToolFrame, ToolState, Tools},
};
use eddy_messages::{Message as _, Point, PoseStamped, TFMessage, TransformStamped};

use super::{
    file::{FollowedTool, PoseSource, ToolsFile},
    rigid::{Moving, Rigid},
    track::{Sample, Track},
    tree::{Reading, Tree},
    warnings::{About, Warnings},
};

/// Maximum number of frames that wait for poses; before further ones, the first is not waited for any longer.
const MAX_WAITING: usize = 4096;

/// Which frame of particles it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FramePlace {
    /// Id of its stream.
    pub stream: u64,
    /// Its number in the stream.
    pub sequence: u64,
    /// Its stamp.
    pub stamp: Stamp,
}

/// What has become of the frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FollowCounts {
    /// Frames of particles.
    pub frames: u64,
    /// Those whose tools have poses.
    pub published: u64,
    /// Those among them in which a tool holds its last pose.
    pub held: u64,
    /// Messages that cannot be used.
    pub refused: u64,
}

/// Finds where tools are at each frame of particles. The same messages give the same poses, in whichever order those of different topics arrive, as long
/// as none is later than the wait.
#[derive(Debug)]
pub struct ToolFollower {
    tools: Vec<Followed>,
    tree: Tree,
    wait: Duration,
    /// Frames with the times of their arrival.
    waiting: VecDeque<(FramePlace, Duration)>,
    counts: FollowCounts,
    warnings: Warnings,
}

/// A tool without a pose, and why.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{tool}: {reason}")]
pub struct NoPose {
    /// The tool and the source of its poses.
    pub tool: String,
    /// What was found, and what was expected.
    pub reason: InvalidTool,
}

/// A tool and where its poses come from.
#[derive(Debug)]
struct Followed {
    body: Tool,
    source: PoseSource,
    parent: String,
    /// Its poses, if they are on a topic.
    track: Track,
}

impl ToolFollower {
    /// A frame waits for up to `wait` for poses that are not older.
    ///
    /// # Errors
    /// [`InvalidTool`] for no tools, and for the first that cannot be.
    pub fn new(file: &ToolsFile, wait: Duration) -> Result<Self, InvalidTool> {
        let sources = file.sources()?.into_iter();
        let followed = |(tool, source): (&FollowedTool, PoseSource)| Followed {
            body: tool.body(),
            source,
            parent: tool.parent.clone(),
            track: Track::default(),
        };
        Ok(Self {
            tools: file.tools.iter().zip(sources).map(followed).collect(),
            tree: Tree::default(),
            wait,
            waiting: VecDeque::new(),
            counts: FollowCounts::default(),
            warnings: Warnings::default(),
        })
    }

    /// What the tools of a stream are.
    pub fn tools(&self, stream: u64) -> Tools {
        Tools { stream, tools: self.tools.iter().map(|tool| tool.body.clone()).collect() }
    }

    /// The topics of poses, each once.
    pub fn pose_topics(&self) -> Vec<String> {
        let topics = self.tools.iter().filter_map(|tool| match &tool.source {
            PoseSource::Topic(topic) => Some(topic.clone()),
            PoseSource::Frame(_) => None,
        });
        topics.collect::<BTreeSet<_>>().into_iter().collect()
    }

    /// Whether a tool has its pose from `/tf`.
    pub fn needs_transforms(&self) -> bool {
        self.tools.iter().any(|tool| matches!(tool.source, PoseSource::Frame(_)))
    }

    /// What has become of the frames so far.
    pub fn counts(&self) -> FollowCounts {
        self.counts
    }

    /// What the user should know since the last call.
    pub fn warnings(&mut self) -> Vec<String> {
        self.warnings.take()
    }

    /// A message of a topic is not what it should be; `reason` names the topic.
    pub fn on_unreadable(&mut self, reason: &str, now: Duration) {
        self.counts.refused += 1;
        self.warnings.say(None, About::Refused, now, || reason.to_owned());
    }

    /// A pose has arrived on a topic.
    pub fn on_pose(&mut self, topic: &str, message: &PoseStamped, now: Duration) {
        for (index, tool) in self.tools.iter_mut().enumerate() {
            let is_source = matches!(&tool.source, PoseSource::Topic(other) if other == topic);
            if is_source && let Err(refused) = tool.add(message) {
                self.counts.refused += 1;
                let text = || format!("{tool}: {refused}");
                self.warnings.say(Some(index), About::Refused, now, text);
            }
        }
    }

    /// Transforms have arrived on `/tf`, or on `/tf_static`. Those that no tool depends on are not judged.
    pub fn on_transforms(&mut self, message: &TFMessage, is_static: bool, now: Duration) {
        for transform in &message.transforms {
            let Err(refused) = add(&mut self.tree, transform, is_static) else { continue };
            let child = &transform.child_frame_id;
            for (index, tool) in self.tools.iter().enumerate() {
                let PoseSource::Frame(frame) = &tool.source else { continue };
                if self.tree.passes(child, frame, &tool.parent) {
                    self.counts.refused += 1;
                    let text = || format!("{tool}: transform of {child:?}: {refused}");
                    self.warnings.say(Some(index), About::Refused, now, text);
                }
            }
        }
    }

    /// A frame of particles has arrived.
    pub fn on_frame(&mut self, place: FramePlace, now: Duration) {
        self.counts.frames += 1;
        self.waiting.push_back((place, now));
    }

    /// The frames whose tools are known, or not waited for any longer, in the order of their arrival.
    pub fn due(&mut self, now: Duration) -> Vec<ToolFrame> {
        let mut frames = Vec::new();
        while let Some(&(place, arrived)) = self.waiting.front() {
            let is_over = now.saturating_sub(arrived) >= self.wait;
            let readings: Vec<_> =
                self.tools.iter().map(|tool| self.read(tool, place.stamp)).collect();
            let is_known = readings.iter().all(|it| matches!(it, Reading::Known(_)));
            if !is_known && !is_over && self.waiting.len() <= MAX_WAITING {
                break;
            }
            self.waiting.pop_front();
            frames.extend(self.resolve(place, &readings, now));
        }
        frames
    }

    /// Where each tool was last, whatever the stamps.
    ///
    /// # Errors
    /// [`NoPose`] for the first that has none in the plane.
    pub fn newest(&self) -> Result<Vec<Pose>, NoPose> {
        let newest = |tool: &Followed| {
            let pose = match self.read(tool, Stamp(i64::MAX)) {
                Reading::Known(moving) | Reading::NotYet(moving, _) => state(&moving),
                Reading::Missing(found, expected) => Err(InvalidTool::new("pose", found, expected)),
                Reading::TooEarly(_) => unreachable!("no stamp is later"),
            };
            pose.map(|state| state.pose).map_err(|reason| NoPose { tool: tool.to_string(), reason })
        };
        self.tools.iter().map(newest).collect()
    }

    /// All frames that still wait, at the end.
    pub fn finish(&mut self, now: Duration) -> Vec<ToolFrame> {
        self.wait = Duration::ZERO;
        self.due(now)
    }

    /// When a frame is not waited for any longer.
    pub fn next_due(&self) -> Option<Duration> {
        self.waiting.front().map(|(_, arrived)| arrived.saturating_add(self.wait))
    }

    /// Where a tool is at a time.
    fn read(&self, tool: &Followed, stamp: Stamp) -> Reading {
        match &tool.source {
            PoseSource::Frame(frame) => self.tree.at(frame, &tool.parent, stamp),
            PoseSource::Topic(_) => match tool.track.at(stamp) {
                Sample::Known(moving) => Reading::Known(moving),
                Sample::NotYet(held, since) => Reading::NotYet(held.at_rest(), since),
                Sample::TooEarly(first) => Reading::TooEarly(first),
                Sample::Nothing => {
                    Reading::Missing("no pose yet".into(), format!("a {}", PoseStamped::TYPE))
                }
            },
        }
    }

    /// The tools at a frame; `None` unless all have poses.
    fn resolve(
        &mut self,
        FramePlace { stream, sequence, stamp }: FramePlace,
        readings: &[Reading],
        now: Duration,
    ) -> Option<ToolFrame> {
        let mut states = Vec::new();
        for (index, (tool, reading)) in self.tools.iter().zip(readings).enumerate() {
            states.extend(judge(tool, index, reading, stamp, now, &mut self.warnings));
        }
        if states.len() < self.tools.len() {
            return None;
        }
        self.counts.published += 1;
        let is_held = readings.iter().any(|it| matches!(it, Reading::NotYet(..)));
        self.counts.held += u64::from(is_held);
        Some(ToolFrame { stream, sequence, stamp, states, wrenches: Vec::new() })
    }
}

/// The state of a tool as far as it is known; says what is wrong with it.
fn judge(
    tool: &Followed,
    index: usize,
    reading: &Reading,
    stamp: Stamp,
    now: Duration,
    warnings: &mut Warnings,
) -> Option<ToolState> {
    let at = stamp.seconds();
    let mut say = |about, field: &str, found: String, expected: String| {
        let wrong = InvalidTool::new(field, found, expected);
        warnings.say(Some(index), about, now, || format!("{tool}: {wrong}"));
    };
    let moving = match reading {
        Reading::Known(moving) | Reading::NotYet(moving, _) => moving,
        Reading::TooEarly(first) => {
            let found = format!("a first pose at {} s", first.seconds());
            let expected = format!("one before the frame's {at} s: the frame has no tools");
            say(About::Missing, "header.stamp", found, expected);
            return None;
        }
        Reading::Missing(found, expected) => {
            let expected = format!("{expected}: the frame has no tools");
            say(About::Missing, "pose", found.clone(), expected);
            return None;
        }
    };
    let state = state(moving);
    if let Reading::NotYet(_, since) = reading {
        let found = format!("a last pose at {} s, which is held", since.seconds());
        say(About::Held, "header.stamp", found, format!("one at or after the frame's {at} s"));
    }
    if let Err(InvalidTool { field, found, expected }) = &state {
        say(About::OutOfPlane, field, found.clone(), expected.clone());
    }
    warnings.ended(index, About::Missing);
    if matches!(reading, Reading::Known(_)) {
        warnings.ended(index, About::Held);
    }
    if state.is_ok() {
        warnings.ended(index, About::OutOfPlane);
    }
    state.ok()
}

/// In the plane.
fn state(moving: &Moving) -> Result<ToolState, InvalidTool> {
    let ([x, y], angle) = moving.at.pose().in_plane("pose")?;
    let ([u, v, _], [.., spin]) = (moving.velocity, moving.spin);
    let [u, v, spin] = [u, v, spin].map(|number| number as f32);
    if ![u, v, spin].iter().all(|number| number.is_finite()) {
        let found = format!("a velocity of {u}, {v}, {spin}");
        return Err(InvalidTool::new("twist", found, "finite numbers"));
    }
    let pose = Pose { position: [x as f32, y as f32], angle: angle as f32 };
    Ok(ToolState { pose, velocity: [u, v], spin })
}

impl Followed {
    /// Adds a pose of its topic.
    fn add(&mut self, PoseStamped { header, pose }: &PoseStamped) -> Result<(), InvalidTool> {
        if header.frame_id != self.parent {
            let [found, expected] = [&header.frame_id, &self.parent].map(|id| format!("{id:?}"));
            return Err(InvalidTool::new("header.frame_id", found, expected));
        }
        let ([x, y], angle) = pose.in_plane("pose")?;
        // Exactly in the plane, where it stays between two poses.
        let (sin, cos) = libm::sincos(0.5 * angle);
        let at = Rigid { position: [x, y, 0.0], rotation: [0.0, 0.0, sin, cos] };
        let stamp = header.stamp.into();
        self.track.push(stamp, at).map_err(|refused| refused.in_words(stamp))
    }
}

/// Adds a transform to a tree.
fn add(
    tree: &mut Tree,
    TransformStamped { header, child_frame_id, transform }: &TransformStamped,
    is_static: bool,
) -> Result<(), InvalidTool> {
    let [x, y, z] = [transform.translation.x, transform.translation.y, transform.translation.z];
    let pose = eddy_messages::Pose { position: Point { x, y, z }, orientation: transform.rotation };
    pose.check("transform")?;
    let names = [&*header.frame_id, &**child_frame_id];
    tree.add(names, header.stamp.into(), Rigid::of(&pose), is_static)
}

impl fmt::Display for Followed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.source {
            PoseSource::Topic(topic) => write!(f, "tool {:?} on {topic}", self.body.name),
            PoseSource::Frame(frame) => write!(f, "tool {:?} in {frame}", self.body.name),
        }
    }
}
