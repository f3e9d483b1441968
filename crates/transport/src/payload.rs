//! A message in the form in which a transport delivers it.

#[cfg(feature = "shm")]
use super::SharedFrame;
use eddy_frames::{Frame, FrameView};
use eddy_messages::{BadFrame, FrameCdr, cdr};

/// A message in the form in which a transport delivers it.
#[derive(Debug)]
pub enum Payload {
    /// A checked frame.
    Frame(Frame),
    /// A frame in shared memory, borrowed until this is dropped.
    #[cfg(feature = "shm")]
    Shared(SharedFrame),
    /// CDR bytes with their 4-byte header, unchecked.
    Cdr(Vec<u8>),
}

impl Payload {
    /// Decodes bytes, or checks a frame in shared memory in place; [`Payload::view`] then returns the frame.
    ///
    /// # Errors
    /// [`BadFrame`] when it is not a valid frame; the payload is unchanged.
    pub fn decode(&mut self) -> Result<(), BadFrame> {
        match self {
            Self::Frame(_) => {}
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.check()?,
            Self::Cdr(bytes) => *self = Self::Frame(Frame::from_cdr(bytes)?),
        }
        Ok(())
    }

    /// The frame, without a copy; `None` before [`Payload::decode`].
    pub fn view(&self) -> Option<FrameView<'_>> {
        match self {
            Self::Frame(frame) => Some(frame.into()),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.view(),
            Self::Cdr(_) => None,
        }
    }

    /// The stream id, also of an unchecked frame.
    pub fn stream(&self) -> Option<u64> {
        match self {
            Self::Frame(frame) => Some(frame.stream),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => Some(shared.stream()),
            Self::Cdr(bytes) => cdr::stream_of_frame(bytes),
        }
    }

    /// The frame, decoded if necessary.
    ///
    /// # Errors
    /// [`BadFrame`] when it is not a valid frame.
    pub fn into_frame(self) -> Result<Frame, BadFrame> {
        match self {
            Self::Frame(frame) => Ok(frame),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => Ok(shared.to_frame()?),
            Self::Cdr(bytes) => Frame::from_cdr(&bytes),
        }
    }

    /// Size in memory (bytes).
    pub fn size(&self) -> usize {
        match self {
            Self::Frame(frame) => size_of_val(&*frame.position) * 2 + frame.len(),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.size(),
            Self::Cdr(bytes) => bytes.len(),
        }
    }

    /// The CDR bytes, encoded if necessary.
    pub fn into_cdr(self) -> Vec<u8> {
        match self {
            Self::Frame(frame) => frame.to_cdr(),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.to_cdr(),
            Self::Cdr(bytes) => bytes,
        }
    }
}

/// The clone of a frame in shared memory is a copy.
impl Clone for Payload {
    fn clone(&self) -> Self {
        match self {
            Self::Frame(frame) => Self::Frame(frame.clone()),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.copy(),
            Self::Cdr(bytes) => Self::Cdr(bytes.clone()),
        }
    }
}

/// Equal messages are equal in all forms.
impl PartialEq for Payload {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Frame(one), Self::Frame(other)) => one == other,
            (Self::Cdr(one), Self::Cdr(other)) => one == other,
            _ => self.clone().into_cdr() == other.clone().into_cdr(),
        }
    }
}
