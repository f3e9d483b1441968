//! PNG files and animations.

use std::{
    fs::File,
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

use super::{canvas::Canvas, quantize::Quantizer, video::Video};

/// Why a picture could not be written.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "each variant's message shows its fields")]
pub enum PictureError {
    /// An I/O error.
    #[error("{path}: {action}: {reason}", path = .path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The failed operation.
        action: &'static str,
        reason: io::Error,
    },
    /// The picture cannot be encoded.
    #[error("{path}: writing the picture: {reason}", path = .path.display())]
    Format {
        /// The file.
        path: PathBuf,
        reason: String,
    },
    /// ffmpeg, which writes MP4, cannot be run or fails.
    #[error("{path}: ffmpeg: {reason}", path = .path.display())]
    Ffmpeg {
        /// The file.
        path: PathBuf,
        reason: String,
    },
    /// A picture is too large for GIF.
    #[error("{path}: size: found {width} x {height} pixels, expected at most 65535 each", path = .path.display())]
    Size {
        /// The file.
        path: PathBuf,
        /// Width (pixels).
        width: usize,
        /// Height (pixels).
        height: usize,
    },
}

/// Format of an animation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// GIF: 256 colours, supported everywhere.
    Gif,
    /// Animated PNG: all colours, supported by browsers.
    Apng,
    /// MP4: small, for presentations and video players. Needs `ffmpeg` on the PATH.
    Mp4,
}

/// Writes a PNG.
///
/// # Errors
/// [`PictureError::Io`], [`PictureError::Format`].
pub fn write_png(path: &Path, canvas: &Canvas) -> Result<(), PictureError> {
    let mut writer = png_encoder(create(path)?, canvas.width(), canvas.height())
        .write_header()
        .map_err(|error| of_png(path, error))?;
    writer.write_image_data(canvas.pixels().as_flattened()).map_err(|error| of_png(path, error))?;
    writer.finish().map_err(|error| of_png(path, error))
}

/// A PNG in memory, with maximum compression.
///
/// # Errors
/// A picture without pixels.
pub fn png_bytes(canvas: &Canvas) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, canvas.width() as u32, canvas.height() as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(canvas.pixels().as_flattened())?;
        writer.finish()
    });
    written.map_err(io::Error::other)?;
    Ok(bytes)
}

/// Writes an animation; GIF and PNG repeat forever.
pub struct Animation {
    path: PathBuf,
    writer: Writer,
}

enum Writer {
    Gif { encoder: gif::Encoder<BufWriter<File>>, quantizer: Quantizer, delay: u16 },
    Apng(png::Writer<BufWriter<File>>),
    Mp4(Video),
}

impl Animation {
    /// Begins an animation of `frames` pictures of equal size, each shown for `delay` hundredths of a second.
    ///
    /// # Errors
    /// [`PictureError`].
    pub fn create(
        path: &Path,
        kind: Kind,
        (width, height): (usize, usize),
        frames: usize,
        delay: u16,
    ) -> Result<Self, PictureError> {
        let path = path.to_owned();
        let writer = match kind {
            Kind::Gif => {
                let (Ok(wide), Ok(high)) = (u16::try_from(width), u16::try_from(height)) else {
                    return Err(PictureError::Size { path, width, height });
                };
                let quantizer = Quantizer::new();
                let file = create(&path)?;
                let encoder = gif::Encoder::new(file, wide, high, &quantizer.palette());
                let mut encoder = encoder.map_err(|error| of_gif(&path, error))?;
                let repeat = encoder.set_repeat(gif::Repeat::Infinite);
                repeat.map_err(|error| of_gif(&path, error))?;
                Writer::Gif { encoder, quantizer, delay }
            }
            Kind::Apng => {
                let mut encoder = png_encoder(create(&path)?, width, height);
                let begun = encoder
                    .set_animated(frames as u32, 0)
                    .and_then(|()| encoder.set_frame_delay(delay, 100))
                    .and_then(|()| encoder.write_header());
                Writer::Apng(begun.map_err(|error| of_png(&path, error))?)
            }
            Kind::Mp4 => Writer::Mp4(Video::create(&path, (width, height), delay)?),
        };
        Ok(Self { path, writer })
    }

    /// Appends a picture.
    ///
    /// # Errors
    /// [`PictureError`].
    pub fn add(&mut self, canvas: &Canvas) -> Result<(), PictureError> {
        let path = &self.path;
        match &mut self.writer {
            Writer::Gif { encoder, quantizer, delay } => {
                let frame = gif::Frame {
                    width: canvas.width() as u16,
                    height: canvas.height() as u16,
                    delay: *delay,
                    buffer: quantizer.indices(canvas).into(),
                    ..gif::Frame::default()
                };
                encoder.write_frame(&frame).map_err(|error| of_gif(path, error))
            }
            Writer::Apng(writer) => writer
                .write_image_data(canvas.pixels().as_flattened())
                .map_err(|error| of_png(path, error)),
            Writer::Mp4(video) => video.add(path, canvas),
        }
    }

    /// Finishes the file.
    ///
    /// # Errors
    /// [`PictureError`].
    pub fn finish(self) -> Result<(), PictureError> {
        let Self { path, writer } = self;
        match writer {
            Writer::Gif { encoder, .. } => {
                let mut file = encoder.into_inner().map_err(|error| of_gif(&path, error))?;
                let action = "writing";
                file.flush().map_err(|reason| PictureError::Io { path, action, reason })
            }
            Writer::Apng(writer) => writer.finish().map_err(|error| of_png(&path, error)),
            Writer::Mp4(video) => video.finish(&path),
        }
    }
}

fn create(path: &Path) -> Result<BufWriter<File>, PictureError> {
    let file = File::create_new(path).map_err(|reason| PictureError::Io {
        path: path.into(),
        action: "creating the file",
        reason,
    })?;
    Ok(BufWriter::new(file))
}

fn png_encoder(
    file: BufWriter<File>,
    width: usize,
    height: usize,
) -> png::Encoder<'static, BufWriter<File>> {
    let mut encoder = png::Encoder::new(file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder
}

fn of_png(path: &Path, error: png::EncodingError) -> PictureError {
    let path = path.to_owned();
    match error {
        png::EncodingError::IoError(reason) => PictureError::Io { path, action: "writing", reason },
        other => PictureError::Format { path, reason: other.to_string() },
    }
}

fn of_gif(path: &Path, error: gif::EncodingError) -> PictureError {
    let path = path.to_owned();
    match error {
        gif::EncodingError::Io(reason) => PictureError::Io { path, action: "writing", reason },
        other => PictureError::Format { path, reason: other.to_string() },
    }
}
