//! `eddy bag render`.

use std::{
    fs, iter,
    path::{Path, PathBuf},
};

use anyhow::{bail, ensure};

use super::find_streams;
use crate::{
    cli::{Color, RenderArgs},
    commands::{Interrupt, progress_bar},
};
use eddy_evaluation::picture::{Animation, Canvas, Coloring, Kind, Painter, write_png};
use eddy_exchange::{ExchangeError, FrameSelection, Streams, Track};
use eddy_frames::{Frame, Material};
use eddy_settings::atomic::Staged;

/// Longer side of the domain in a strip (pixels).
const STRIP_SIZE: usize = 240;
/// Longer side of the domain in an animation (pixels).
const ANIMATION_SIZE: usize = 480;
/// Pictures a second of an animation, at most.
const PICTURES: f64 = 25.0;
/// GIF viewers slow shorter delays down (hundredths of a second).
const SHORTEST_DELAY: f64 = 2.0;

/// Draws a stream.
pub fn run(args: RenderArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    ensure!(
        args.rate.is_finite() && args.rate > 0.0,
        "rate: found {}, expected a positive number",
        args.rate
    );
    // Refused before anything is read.
    if let (Some(extension), None) = (args.output.extension(), strip_and_animation(&args.output)) {
        bail!(
            "{}: found .{}, expected .png, .gif, .apng or a folder",
            args.output.display(),
            extension.display()
        );
    }
    let is_folder = strip_and_animation(&args.output).is_none();
    let failed = || ExchangeError::output(&args.output);
    let output = Staged::new(&args.output).map_err(failed())?;
    if is_folder {
        fs::create_dir(output.path()).map_err(failed())?;
    }
    let find = |topic: &String| {
        let (bags, topic) = (vec![args.bag.clone()], topic.clone());
        find_streams(
            &FrameSelection { bags, topic, stream: args.stream, frames: None },
            quiet,
            interrupt,
        )
    };
    let sides = args.topic.iter().map(find).collect::<Result<Vec<_>, _>>()?;
    let Some((streams, track)) = first_track(&sides) else {
        bail!("{}: no stream", args.bag.display())
    };
    let wanted = strip_and_animation(&args.output).unwrap_or((true, Some(Kind::Gif)));
    let names = if is_folder {
        [output.path().join("strip.png"), output.path().join("animation.gif")]
    } else {
        [output.path(), output.path()]
    };
    draw(&args, &sides, track, wanted, names, quiet, interrupt)?;
    output.commit().map_err(failed())?;
    let others = streams.tracks().len() - 1;
    let others = if others > 0 { format!(" ({others} more in the bag)") } else { String::new() };
    println!("stream {}{others}: {}", track.stream, args.output.display());
    Ok(())
}

/// The stream that is drawn: the first one of the first topic.
fn first_track(sides: &[Streams]) -> Option<(&Streams, &Track)> {
    let streams = sides.first()?;
    Some((streams, streams.tracks().first()?))
}

/// Whether a lone file of this name is a strip, and which animation; `None` for a directory.
fn strip_and_animation(path: &Path) -> Option<(bool, Option<Kind>)> {
    match path.extension()?.to_str()? {
        "png" => Some((true, None)),
        "gif" => Some((false, Some(Kind::Gif))),
        "apng" => Some((false, Some(Kind::Apng))),
        _ => None,
    }
}

/// Reads the stream, on each topic, and draws the frames that are shown.
fn draw(
    args: &RenderArgs,
    sides: &[Streams],
    track: &Track,
    (strip, animation): (bool, Option<Kind>),
    [strip_file, animation_file]: [PathBuf; 2],
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let painter = |size| {
        let size = args.size.map_or(size, |size| size as usize);
        Painter::new(track.domain, track.particles(), size, coloring(args.color, track))
    };
    let (small, large) = (painter(STRIP_SIZE), painter(ANIMATION_SIZE));
    let in_strip = evenly(track.frames, if strip { args.frames as usize } else { 0 });
    let (pictures, delay) = pace(track, args.rate);
    let in_animation = evenly(track.frames, if animation.is_some() { pictures } else { 0 });
    let mut panels: Vec<Canvas> = Vec::new();
    let mut film = None;
    let bar = progress_bar(track.frames as u64, "frames", quiet);
    let mut sides =
        sides.iter().map(|side| Side::of(side, track)).collect::<Result<Vec<_>, _>>()?;
    for index in 0..track.frames {
        let Some(frames) = together(&mut sides)? else { break };
        let view = |painter: &Painter| match &frames[..] {
            [Some(frame)] => painter.panel(frame),
            _ => painter.beside(args.topic.iter().map(String::as_str).zip(&frames)),
        };
        if interrupt.requested() {
            return Err(ExchangeError::Interrupted.into());
        }
        if in_strip.binary_search(&index).is_ok() {
            panels.push(view(&small));
        }
        if let Some(kind) = animation.filter(|_| in_animation.binary_search(&index).is_ok()) {
            let picture = large.picture(&view(&large));
            let size = (picture.width(), picture.height());
            if film.is_none() {
                film = Some(Animation::create(
                    &animation_file,
                    kind,
                    size,
                    in_animation.len(),
                    delay,
                )?);
            }
            film.as_mut().map_or(Ok(()), |film| film.add(&picture))?;
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    if strip {
        write_png(&strip_file, &small.strip(&panels))?;
    }
    film.map_or(Ok(()), Animation::finish)?;
    Ok(())
}

/// The frames of a stream on one topic, with one that was read too early.
struct Side {
    frames: Box<dyn Iterator<Item = Result<Frame, ExchangeError>>>,
    next: Option<Frame>,
}

impl Side {
    /// The stream of `track` on the topic of `streams`.
    fn of(streams: &Streams, track: &Track) -> Result<Self, ExchangeError> {
        let same = streams.tracks().iter().find(|other| other.stream == track.stream);
        let frames: Box<dyn Iterator<Item = _>> = match same {
            Some(same) => Box::new(streams.frames_of(same)?),
            None => Box::new(iter::empty()),
        };
        Ok(Self { frames, next: None })
    }

    /// The frame with this sequence number, or nothing if there is none.
    fn frame(&mut self, sequence: u64) -> Result<Option<Frame>, ExchangeError> {
        while self.next.as_ref().is_none_or(|frame| frame.sequence < sequence) {
            self.next = self.frames.next().transpose()?;
            if self.next.is_none() {
                break;
            }
        }
        Ok(self.next.take_if(|frame| frame.sequence == sequence))
    }
}

/// The first topic's next frame and those of the others that belong to it; nothing at its end.
fn together(sides: &mut [Side]) -> Result<Option<Vec<Option<Frame>>>, ExchangeError> {
    let Some((first, others)) = sides.split_first_mut() else { return Ok(None) };
    let Some(frame) = first.frames.next().transpose()? else { return Ok(None) };
    let others = others.iter_mut().map(|side| side.frame(frame.sequence));
    let others = others.collect::<Result<Vec<_>, _>>()?;
    Ok(Some(iter::once(Some(frame)).chain(others).collect()))
}

fn coloring(color: Color, track: &Track) -> Coloring {
    match color {
        Color::Material => {
            let occurs = |material: &Material| track.material.contains(material);
            Coloring::Material(Material::ALL.into_iter().filter(occurs).collect())
        }
        Color::Speed => Coloring::Speed(track.top_speed),
    }
}

/// `count` of `frames` numbers, evenly spaced from the first to the last; all if there are fewer.
fn evenly(frames: usize, count: usize) -> Vec<usize> {
    let count = count.min(frames);
    (0..count).map(|i| i * (frames - 1) / (count - 1).max(1)).collect()
}

/// How many pictures an animation has, and how long each is shown (hundredths of a second).
fn pace(track: &Track, rate: f64) -> (usize, u16) {
    let seconds = (track.last.seconds() - track.first.seconds()) / rate;
    let last = (seconds * PICTURES).ceil().clamp(0.0, (track.frames - 1) as f64);
    let pictures = last as usize + 1;
    let delay = 100.0 * seconds / pictures.saturating_sub(1).max(1) as f64;
    (pictures, delay.round().max(SHORTEST_DELAY) as u16)
}
