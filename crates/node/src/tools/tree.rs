//! The transforms between coordinate frames, as `/tf` and `/tf_static` tell them.

use std::collections::BTreeMap;

use eddy_frames::{Stamp, tool::InvalidTool};

use super::{
    rigid::{Moving, Rigid},
    track::{NotLater, Sample, Track},
};

/// Maximum number of child frames.
const MAX_FRAMES: usize = 1024;
/// Maximum number of transforms in a chain.
const MAX_CHAIN: usize = 64;

/// All known transforms, by child.
#[derive(Debug, Default)]
pub(super) struct Tree {
    edges: BTreeMap<String, Edge>,
}

#[derive(Debug)]
struct Edge {
    parent: String,
    track: Track,
}

/// What is known of a tool at a time.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Reading {
    /// Where it is.
    Known(Moving),
    /// Where it was last, and the stamp of the pose that a later one should follow.
    NotYet(Moving, Stamp),
    /// Its first pose has this stamp, which is later.
    TooEarly(Stamp),
    /// What was found instead, and what was expected.
    Missing(String, String),
}

impl Tree {
    /// Adds the pose of a child in its parent; if it is static, for all times.
    ///
    /// # Errors
    /// [`InvalidTool`], with the field of the message.
    pub(super) fn add(
        &mut self,
        [parent, child]: [&str; 2],
        stamp: Stamp,
        at: Rigid,
        is_static: bool,
    ) -> Result<(), InvalidTool> {
        if parent.is_empty() || child.is_empty() || parent == child {
            let found = format!("{child:?} in the frame {parent:?}");
            return Err(InvalidTool::new("child_frame_id", found, "two different frames"));
        }
        if !self.edges.contains_key(child) && self.edges.len() >= MAX_FRAMES {
            let expected = format!("at most {MAX_FRAMES} child frames");
            let found = format!("{child:?}, one more");
            return Err(InvalidTool::new("child_frame_id", found, expected));
        }
        let empty = || Edge { parent: parent.to_owned(), track: Track::default() };
        let edge = self.edges.entry(child.to_owned()).or_insert_with(empty);
        if edge.parent != parent {
            *edge = empty();
        }
        if is_static {
            edge.track = Track::fixed(at);
            return Ok(());
        }
        edge.track.push(stamp, at).map_err(|refused| refused.in_words(stamp))
    }

    /// The frames from one outwards to its farthest known ancestor, or to `outermost`.
    fn chain<'a>(&'a self, frame: &'a str, outermost: &str) -> Vec<&'a str> {
        let mut chain = vec![frame];
        let mut innermost = frame;
        while innermost != outermost
            && chain.len() <= MAX_CHAIN
            && let Some(edge) = self.edges.get(innermost)
        {
            innermost = &edge.parent;
            chain.push(innermost);
        }
        chain
    }

    /// Whether the pose of `frame` in `outermost` depends on that of `child` in its parent.
    pub(super) fn passes(&self, child: &str, frame: &str, outermost: &str) -> bool {
        self.chain(frame, outermost).contains(&child)
    }

    /// Where a frame is in another one at a time.
    pub(super) fn at(&self, frame: &str, outermost: &str, stamp: Stamp) -> Reading {
        let chain = self.chain(frame, outermost);
        let expected = format!("transforms of {frame} to {outermost}");
        match chain[..] {
            [only] => return Reading::Missing(format!("no transform of {only} yet"), expected),
            [.., last] if last != outermost => {
                let found = format!("only {} (each in the next)", chain.join(", "));
                return Reading::Missing(found, expected);
            }
            _ => {}
        }
        let mut late: Option<Stamp> = None;
        let mut whole: Option<Moving> = None;
        for child in &chain[..chain.len() - 1] {
            let moving = match self.edges[*child].track.at(stamp) {
                Sample::Known(moving) => moving,
                Sample::NotYet(held, since) => {
                    late = Some(late.map_or(since, |late| late.min(since)));
                    held.at_rest()
                }
                Sample::TooEarly(first) => return Reading::TooEarly(first),
                Sample::Nothing => {
                    let found = format!("no transform of {child} yet");
                    return Reading::Missing(found, expected);
                }
            };
            whole = Some(whole.map_or(moving, |inner| moving.carries(&inner)));
        }
        match (whole, late) {
            (Some(moving), None) => Reading::Known(moving),
            (Some(moving), Some(since)) => Reading::NotYet(moving, since),
            (None, _) => Reading::Missing("a chain of no transform".into(), expected),
        }
    }
}

impl NotLater {
    /// Of a pose with this stamp.
    pub(super) fn in_words(self, stamp: Stamp) -> InvalidTool {
        let [found, last] = [stamp, self.0].map(Stamp::seconds);
        let expected = format!("more than {last} s, that of the pose before");
        InvalidTool::new("header.stamp", format!("{found} s"), expected)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Stamp = Stamp(1_000_000_000);

    fn at(x: f64, y: f64, angle: f64) -> Rigid {
        let (sin, cos) = libm::sincos(0.5 * angle);
        Rigid { position: [x, y, 0.0], rotation: [0.0, 0.0, sin, cos] }
    }

    fn missing(reading: Reading) -> String {
        match reading {
            Reading::Missing(found, _) => found,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn moving_and_static_transforms_are_composed() {
        let mut tree = Tree::default();
        let quarter = std::f64::consts::FRAC_PI_2;
        tree.add(["base", "cup"], Stamp(0), at(2.0, 0.0, 0.0), true).unwrap();
        tree.add(["world", "base"], Stamp(0), at(1.0, 0.0, 0.0), false).unwrap();
        tree.add(["world", "base"], Stamp(2 * NOW.0), at(1.0, 2.0, quarter), false).unwrap();
        let Reading::Known(moving) = tree.at("cup", "world", NOW) else { panic!("known") };
        let (sin, cos) = libm::sincos(0.5 * quarter);
        let expected = [1.0 + 2.0 * cos, 1.0 + 2.0 * sin, 0.0];
        let spin = 0.5 * quarter;
        let velocity = [-2.0 * sin * spin, 1.0 + 2.0 * cos * spin, 0.0];
        for k in 0..3 {
            assert!((moving.at.position[k] - expected[k]).abs() < 1e-12, "{moving:?}");
            assert!((moving.velocity[k] - velocity[k]).abs() < 1e-12, "{moving:?}");
        }
        assert!((moving.spin[2] - spin).abs() < 1e-12);
        // In the frame of its parent it rests.
        let in_base = tree.at("cup", "base", NOW);
        assert_eq!(in_base, Reading::Known(at(2.0, 0.0, 0.0).at_rest()));
    }

    #[test]
    fn a_chain_waits_for_each_of_its_transforms() {
        let mut tree = Tree::default();
        assert_eq!(missing(tree.at("cup", "world", NOW)), "no transform of cup yet");
        tree.add(["base", "cup"], NOW, at(1.0, 0.0, 0.0), false).unwrap();
        let found = missing(tree.at("cup", "world", NOW));
        assert_eq!(found, "only cup, base (each in the next)");
        tree.add(["world", "base"], Stamp(5), at(0.0, 1.0, 0.0), false).unwrap();
        let held = at(1.0, 1.0, 0.0).at_rest();
        assert_eq!(tree.at("cup", "world", NOW), Reading::NotYet(held, Stamp(5)));
        assert_eq!(tree.at("cup", "world", Stamp(9)), Reading::TooEarly(NOW));
        tree.add(["world", "base"], NOW, at(0.0, 1.0, 0.0), false).unwrap();
        assert_eq!(tree.at("cup", "world", NOW), Reading::Known(held));
        // The oldest of several late ones is named.
        let [next, later] = [Stamp(NOW.0 + 1), Stamp(NOW.0 + 2)];
        tree.add(["world", "base"], next, at(0.0, 1.0, 0.0), false).unwrap();
        assert_eq!(tree.at("cup", "world", later), Reading::NotYet(held, NOW));
        // A new parent starts a new history.
        tree.add(["map", "base"], NOW, at(0.0, 1.0, 0.0), false).unwrap();
        let found = missing(tree.at("cup", "world", NOW));
        assert_eq!(found, "only cup, base, map (each in the next)");
    }

    #[test]
    fn loops_and_too_many_frames_are_no_chain() {
        let mut tree = Tree::default();
        let zero = at(0.0, 0.0, 0.0);
        tree.add(["a", "b"], NOW, zero, true).unwrap();
        tree.add(["b", "a"], NOW, zero, true).unwrap();
        assert!(missing(tree.at("a", "world", NOW)).starts_with("only a, b, a, "));
        assert!(tree.passes("b", "a", "world") && !tree.passes("c", "a", "world"));
        for names in [["a", "a"], ["", "a"], ["a", ""]] {
            assert_eq!(tree.add(names, NOW, zero, false).unwrap_err().field, "child_frame_id");
        }
        for number in 0..2 * MAX_FRAMES {
            let _ = tree.add(["a", &format!("n{number}")], NOW, zero, false);
        }
        assert_eq!(tree.edges.len(), MAX_FRAMES);
    }
}
