//! `eddy bag render`.

use std::{
    collections::BTreeMap,
    fs, iter,
    path::{Path, PathBuf},
};

use anyhow::bail;

use super::find_streams;
use crate::cli::{Color, RenderArgs};
use eddy_bag::{BagReader, RecordedTools};
use eddy_cli::{Interrupt, Output, OutputKind, progress_bar};
use eddy_exchange::{AlignedFrames, ExchangeError, FrameSelection, Frames, Streams, Track};
use eddy_frames::{
    Frame, Material,
    tool::{ForceScale, Shape},
};
use eddy_pages::picture::{
    Animation, Canvas, Coloring, Kind, Painter, animation_timing, evenly_spaced, write_png,
};
use eddy_settings::{atomic::Staged, usage::Usage};

/// Longer side of the domain in a strip (pixels).
const STRIP_SIZE: usize = 240;
/// Longer side of the domain in an animation (pixels).
const ANIMATION_SIZE: usize = 480;

/// Renders a stream.
pub fn run(args: RenderArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    // Checked before anything is read.
    if let (Some(extension), None) = (args.output.extension(), strip_and_animation(&args.output)) {
        return Err(Usage::new(format_args!(
            "{}: found .{}, expected .png, .gif, .apng, .mp4 or a directory",
            args.output.display(),
            extension.display()
        ))
        .into());
    }
    let is_folder = strip_and_animation(&args.output).is_none();
    let room = Output::at(
        &args.output,
        OutputKind::Pictures,
        args.force,
        std::slice::from_ref(&args.bag),
    )?;
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
        bail!("{}: no streams", args.bag.display())
    };
    let wanted = strip_and_animation(&args.output).unwrap_or((true, Some(Kind::Gif)));
    let names = if is_folder {
        [output.path().join("strip.png"), output.path().join("animation.gif")]
    } else {
        [output.path(), output.path()]
    };
    draw(&args, &sides, track, wanted, names, quiet, interrupt)?;
    output.commit().map_err(failed())?;
    room.replaced();
    let others = streams.tracks().len() - 1;
    let others = if others > 0 { format!(" ({others} more in the bag)") } else { String::new() };
    println!("stream {}{others}: {}", track.stream, args.output.display());
    Ok(())
}

/// The stream to render: the first one of the first topic.
fn first_track(sides: &[Streams]) -> Option<(&Streams, &Track)> {
    let streams = sides.first()?;
    Some((streams, streams.tracks().first()?))
}

/// Whether a file of this name is a strip, and which animation it is; `None` for a directory.
fn strip_and_animation(path: &Path) -> Option<(bool, Option<Kind>)> {
    match path.extension()?.to_str()? {
        "png" => Some((true, None)),
        "gif" => Some((false, Some(Kind::Gif))),
        "apng" => Some((false, Some(Kind::Apng))),
        "mp4" => Some((false, Some(Kind::Mp4))),
        _ => None,
    }
}

/// Reads the stream on each topic and draws the selected frames.
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
    let in_strip = evenly_spaced(track.frames, if strip { args.frames as usize } else { 0 });
    let seconds = (track.last.seconds() - track.first.seconds()) / args.rate;
    let (pictures, delay) = animation_timing(seconds, track.frames);
    let in_animation = evenly_spaced(track.frames, if animation.is_some() { pictures } else { 0 });
    // One row per topic.
    let mut rows: Vec<Vec<Canvas>> = vec![Vec::new(); sides.len()];
    let mut film = None;
    let tools: Vec<_> = args.topic.iter().map(|topic| DrawnTools::of(track, topic)).collect();
    let bar = progress_bar(track.frames as u64, "frames", quiet);
    let mut sides = sides.iter().map(|side| frames_of(side, track.stream));
    let first = sides.next().unwrap_or_else(|| Ok(Box::new(iter::empty())))?;
    let aligned = AlignedFrames::new(first, sides.collect::<Result<_, _>>()?);
    for (index, frames) in aligned.enumerate() {
        let frames = frames?;
        let views = |painter: &Painter| -> Vec<Canvas> {
            let panel = |((topic, frame), tools): ((&String, &Option<Frame>), &DrawnTools)| {
                let shapes = frame.as_ref().map_or_else(Vec::new, |frame| tools.at(frame.sequence));
                match frame {
                    Some(frame) if args.topic.len() == 1 => painter.panel(frame, &shapes),
                    frame => painter.named_panel(topic, frame.as_ref(), &shapes),
                }
            };
            args.topic.iter().zip(&frames).zip(&tools).map(panel).collect()
        };
        if interrupt.requested() {
            return Err(ExchangeError::Interrupted.into());
        }
        if in_strip.binary_search(&index).is_ok() {
            rows.iter_mut().zip(views(&small)).for_each(|(row, panel)| row.push(panel));
        }
        if let Some(kind) = animation.filter(|_| in_animation.binary_search(&index).is_ok()) {
            let picture = large.picture(&large.beside(&views(&large)));
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
        write_png(&strip_file, &small.strip(&rows))?;
    }
    film.map_or(Ok(()), Animation::finish)?;
    Ok(())
}

/// The tools of the stream that is drawn.
struct DrawnTools(Option<(RecordedTools, ForceScale)>);

impl DrawnTools {
    /// Those beside a topic; none if the bag has none, or they cannot be used, which is logged.
    fn of(track: &Track, topic: &str) -> Self {
        let read = BagReader::open(&track.bag).and_then(|bag| bag.tools(topic));
        let all = read.unwrap_or_else(|error| {
            tracing::warn!("{error}; drawn without tools");
            BTreeMap::new()
        });
        let height = track.domain.upper[1] - track.domain.lower[1];
        let of_stream = all.into_iter().find(|(stream, _)| *stream == track.stream);
        Self(of_stream.map(|(_, tools)| {
            let scale = tools.force_scale(height);
            (tools, scale)
        }))
    }

    /// Their shapes at a frame.
    fn at(&self, sequence: u64) -> Vec<Shape> {
        let tools = self.0.as_ref();
        tools.map_or_else(Vec::new, |(tools, scale)| tools.shapes_at(sequence, *scale))
    }
}

/// The frames of a stream on one topic; none if the topic lacks the stream.
fn frames_of(streams: &Streams, stream: u64) -> Result<Frames, ExchangeError> {
    match streams.tracks().iter().find(|track| track.stream == stream) {
        Some(track) => Ok(Box::new(streams.frames_of(track)?)),
        None => Ok(Box::new(iter::empty())),
    }
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
