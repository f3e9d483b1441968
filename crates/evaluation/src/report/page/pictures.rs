//! Pictures of rollouts (the paper's Fig. 7).

use std::io;

use super::{super::scenes::joined, Report};
use crate::Snapshot;
use eddy_frames::{Frame, tool::Shape};
use eddy_pages::{
    Picture, PictureGrid, Section,
    picture::{Coloring, Painter, png_bytes},
};

/// Longer side of the domain (pixels); shown at half this size.
const SIZE: usize = 260;

impl Report {
    pub(super) fn pictures(&self, section: &mut Section) -> io::Result<()> {
        let (names, snapshots) = &self.snapshots;
        let have_tools = snapshots.iter().flat_map(|one| &one.tools).any(|tools| !tools.is_empty());
        let tools = match have_tools {
            true => " Tools are grey, with a red arrow for the force of true matter on each.",
            false => "",
        };
        section.paragraph(&format!(
            "One free rollout in a scene of each kind: the truth above the predictions from the same frame. Colours are \
             materials: liquid dark blue, snow light blue, jelly orange, rope red, sand pink.{tools}"
        ));
        for snapshot in snapshots {
            section.pictures(&grid(names, snapshot)?);
        }
        Ok(())
    }
}

fn grid(names: &[String], snapshot: &Snapshot) -> io::Result<PictureGrid> {
    let Snapshot { scene, materials, start, ahead, truth, tools, predicted } = snapshot;
    let painter = truth.first().map(|first| {
        Painter::new(first.domain, first.len(), SIZE, Coloring::Material(materials.clone()))
    });
    let row = |name: &str, frames: &[Frame]| -> io::Result<(String, Vec<Picture>)> {
        let picture = |((frame, ahead), tools): ((&Frame, &usize), &Vec<Shape>)| {
            let Some(painter) = &painter else { return Err(io::Error::other("no frame")) };
            let canvas = painter.particles(frame, tools);
            let size = [canvas.width(), canvas.height()];
            let words = format!("{scene}: {name}, {ahead} frames ahead");
            Ok(Picture { png: png_bytes(&canvas)?, size, words })
        };
        let pictures =
            frames.iter().zip(ahead).zip(tools).map(picture).collect::<io::Result<_>>()?;
        Ok((name.to_owned(), pictures))
    };
    let mut rows = vec![row("truth", truth)?];
    for (name, frames) in names.iter().zip(predicted) {
        rows.push(row(name, frames)?);
    }
    Ok(PictureGrid {
        caption: format!(
            "{scene} ({}), starting from frame {start} of the stream.",
            joined(materials)
        ),
        columns: ahead.iter().map(|ahead| format!("frame {ahead}")).collect(),
        rows,
    })
}
