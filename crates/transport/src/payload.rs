//! One message, in the form in which its transport delivers it.

#[cfg(feature = "shm")]
use super::SharedFrame;
use eddy_frames::{Frame, FrameView};
use eddy_messages::{BadFrame, FrameCdr, cdr};

/// One message as a transport delivers it.
#[derive(Debug)]
pub enum Payload {
    /// A frame of its own, already checked.
    Frame(Frame),
    /// A frame in shared memory, which is lent until this is dropped.
    #[cfg(feature = "shm")]
    Shared(SharedFrame),
    /// CDR bytes with their 4-byte header, unchecked.
    Cdr(Vec<u8>),
}

impl Payload {
    /// Makes sure that it is a frame, which [`Payload::view`] then shows: bytes are decoded, what lies in
    /// shared memory is checked and stays there.
    ///
    /// # Errors
    /// [`BadFrame`] when it is no usable frame; it stays as it is.
    pub fn decode(&mut self) -> Result<(), BadFrame> {
        match self {
            Self::Frame(_) => {}
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.check()?,
            Self::Cdr(bytes) => *self = Self::Frame(Frame::from_cdr(bytes)?),
        }
        Ok(())
    }

    /// The frame where it lies; `None` for what was not [decoded](Payload::decode).
    pub fn view(&self) -> Option<FrameView<'_>> {
        match self {
            Self::Frame(frame) => Some(frame.into()),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.view(),
            Self::Cdr(_) => None,
        }
    }

    /// The stream of what is a frame, or looks like one.
    pub fn stream(&self) -> Option<u64> {
        match self {
            Self::Frame(frame) => Some(frame.stream),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => Some(shared.stream()),
            Self::Cdr(bytes) => cdr::stream_of_frame(bytes),
        }
    }

    /// The frame, decoded if it came as bytes.
    ///
    /// # Errors
    /// [`BadFrame`] when the bytes are no usable frame.
    pub fn into_frame(self) -> Result<Frame, BadFrame> {
        match self {
            Self::Frame(frame) => Ok(frame),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => Ok(shared.to_frame()?),
            Self::Cdr(bytes) => Frame::from_cdr(&bytes),
        }
    }

    /// The memory it takes (bytes).
    pub fn size(&self) -> usize {
        match self {
            Self::Frame(frame) => size_of_val(&*frame.position) * 2 + frame.len(),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.size(),
            Self::Cdr(bytes) => bytes.len(),
        }
    }

    /// The CDR bytes, encoded if it came as a frame.
    pub fn into_cdr(self) -> Vec<u8> {
        match self {
            Self::Frame(frame) => frame.to_cdr(),
            #[cfg(feature = "shm")]
            Self::Shared(shared) => shared.to_cdr(),
            Self::Cdr(bytes) => bytes,
        }
    }
}

/// What is lent cannot be lent twice: the clone has a frame of its own.
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

/// Equal if they are the same message, whatever form they came in.
impl PartialEq for Payload {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Frame(one), Self::Frame(other)) => one == other,
            (Self::Cdr(one), Self::Cdr(other)) => one == other,
            _ => self.clone().into_cdr() == other.clone().into_cdr(),
        }
    }
}
