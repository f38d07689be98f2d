//! References: a ring without checks, loans or sleeping flags, `sinew_shm::bare`.

use sinew_figures::Figures;
use sinew_shm::bare::End;

use crate::pace::Pace;

pub(crate) fn measure(mut end: End, bytes: usize, pace: Pace) -> Figures {
    let mut buffer = vec![7; bytes];
    pace.time(|| {
        end.send(&buffer);
        end.receive(&mut buffer);
    })
}

/// Echoes until the measuring end kills this process.
pub(crate) fn echo(mut end: End, bytes: usize) {
    let mut buffer = vec![0; bytes];
    loop {
        end.receive(&mut buffer);
        end.send(&buffer);
    }
}
