//! MP4, written by ffmpeg, which reads the pictures from a pipe.

use std::{
    io::{self, Read as _, Write as _},
    path::Path,
    process::{Child, ChildStderr, ChildStdin, Command, Stdio},
};

use super::{canvas::Canvas, file::PictureError};

/// What to do without ffmpeg.
const INSTALL: &str = "install ffmpeg, or choose .gif or .apng";

/// A running ffmpeg.
pub(super) struct Video {
    child: Child,
    pictures: Option<ChildStdin>,
    errors: Option<ChildStderr>,
}

impl Video {
    /// Starts ffmpeg for pictures of this size, each shown for `delay` hundredths of a second.
    ///
    /// # Errors
    /// [`PictureError::Ffmpeg`] when it is not on the PATH.
    pub(super) fn create(
        path: &Path,
        (width, height): (usize, usize),
        delay: u16,
    ) -> Result<Self, PictureError> {
        let mut command = Command::new("ffmpeg");
        command.args(["-loglevel", "error", "-f", "rawvideo", "-pixel_format", "rgb24"]);
        command.args(["-video_size", &format!("{width}x{height}")]);
        command.args(["-framerate", &format!("100/{delay}"), "-i", "pipe:0"]);
        // Most players show only 4:2:0, which needs even sides.
        command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-pix_fmt", "yuv420p"]);
        command.args(["-movflags", "+faststart", "-f", "mp4"]).arg(path);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|error| {
            failed(
                path,
                match error.kind() {
                    io::ErrorKind::NotFound => format!("not found on the PATH; {INSTALL}"),
                    _ => error.to_string(),
                },
            )
        })?;
        let (pictures, errors) = (child.stdin.take(), child.stderr.take());
        Ok(Self { child, pictures, errors })
    }

    /// Appends a picture.
    ///
    /// # Errors
    /// [`PictureError::Ffmpeg`] with what ffmpeg printed.
    pub(super) fn add(&mut self, path: &Path, canvas: &Canvas) -> Result<(), PictureError> {
        let pictures = self.pictures.as_mut();
        match pictures.map(|pipe| pipe.write_all(canvas.pixels().as_flattened())) {
            Some(Ok(())) => Ok(()),
            _ => {
                Err(self.outcome(path).err().unwrap_or_else(|| failed(path, "ended early".into())))
            }
        }
    }

    /// Waits until the file is complete.
    ///
    /// # Errors
    /// [`PictureError::Ffmpeg`] with what ffmpeg printed.
    pub(super) fn finish(mut self, path: &Path) -> Result<(), PictureError> {
        self.outcome(path)
    }

    fn outcome(&mut self, path: &Path) -> Result<(), PictureError> {
        // The end of the pipe is the end of the video.
        self.pictures = None;
        let mut printed = String::new();
        if let Some(mut errors) = self.errors.take() {
            // What cannot be read is not shown.
            let _ = errors.read_to_string(&mut printed);
        }
        match self.child.wait() {
            Ok(status) if status.success() => Ok(()),
            Ok(status) => Err(failed(path, format!("{status}: {}", printed.trim()))),
            Err(error) => Err(failed(path, error.to_string())),
        }
    }
}

impl Drop for Video {
    fn drop(&mut self) {
        // After an error; nothing happens if it has ended.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn failed(path: &Path, reason: String) -> PictureError {
    PictureError::Ffmpeg { path: path.into(), reason }
}
