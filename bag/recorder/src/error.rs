//! Why a recording does not begin, or has no result.

use std::{io, time::Duration};

use sinew_bag::BagError;
use sinew_record::SelectionError;
use sinew_shm::journal::ReadJournalError;

/// Why a recording does not begin, or has no result.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The node does not answer, or does not register the recorder.
    #[error("{0}")]
    NoAnswer(String),
    /// The node does not record for this program.
    #[error("the node does not record: {0}")]
    Refused(String),
    /// The selection is not legal.
    #[error(transparent)]
    Selection(#[from] SelectionError),
    /// The journal of the node cannot be read.
    #[error(transparent)]
    Journal(#[from] ReadJournalError),
    /// The file cannot be made.
    #[error(transparent)]
    File(#[from] BagError),
    /// The system has no thread for it.
    #[error("the system gives no thread for the recording: {0}; end other programs")]
    Thread(#[source] io::Error),
    /// It did not end in time. Its thread still tries to.
    #[error(
        "the recording did not end within {0:?}, as with a disk that hangs; its file is whole up to its last chunk"
    )]
    NotEnded(Duration),
    /// Its thread has panicked.
    #[error("the thread of the recording has panicked: see the log; its file is whole up to its last chunk")]
    Panicked,
}
