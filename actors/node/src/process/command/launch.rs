//! Whether this program, started again, has become the program of a command.

use std::io;

use rustix::net::SendFlags;
use tokio::net::UnixStream;

/// Maximum bytes of a reason that are kept.
const REASON_BYTES_MAX: usize = 512;

/// The node's end of the socket of a process that is to become a program. The kernel closes the other end when it does;
/// a process that does not writes the reason before.
pub(super) struct LaunchReport {
    /// `None` once the other end is closed.
    socket: Option<UnixStream>,
    reason: Vec<u8>,
}

impl LaunchReport {
    pub(super) fn new(socket: std::os::unix::net::UnixStream) -> io::Result<Self> {
        socket.set_nonblocking(true)?;
        Ok(Self { socket: Some(UnixStream::from_std(socket)?), reason: Vec::new() })
    }

    /// Lets the process execute the program. Its group may register the name by now, and its presence is watched.
    pub(super) fn allow(&self) {
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        // The socket has room for this byte. An error means that the process has ended, which its exit status shows.
        self.socket.iter().for_each(|socket| _ = rustix::net::send(socket, &[0], flags));
    }

    /// Reads when something has arrived; never resolves once the other end is closed.
    pub(super) async fn read(&mut self) {
        match &self.socket {
            Some(socket) if socket.readable().await.is_ok() => {}
            Some(_) | None => std::future::pending().await,
        }
        self.read_some();
    }

    /// Returns the reason for which the process has not become the program, if it has reported one. Called at its end.
    pub(super) fn finish(&mut self) -> Option<String> {
        while self.read_some() {}
        (!self.reason.is_empty()).then(|| String::from_utf8_lossy(&self.reason).into_owned())
    }

    /// Reads what has arrived. Returns whether there may be more.
    fn read_some(&mut self) -> bool {
        let Some(socket) = &self.socket else { return false };
        let mut bytes = [0; REASON_BYTES_MAX];
        match socket.try_read(&mut bytes) {
            Err(cause) if cause.kind() == io::ErrorKind::WouldBlock => false,
            Ok(0) | Err(_) => {
                self.socket = None;
                false
            }
            Ok(count) => {
                let room = REASON_BYTES_MAX - self.reason.len();
                self.reason.extend_from_slice(&bytes[..count.min(room)]);
                // Longer ones are those of no process that this node has started.
                room > count
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};

    use super::*;

    #[test]
    fn process_gets_one_byte_when_it_may_begin() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
        let mut read = Vec::new();
        runtime.block_on(async {
            let report = LaunchReport::new(ours).expect("it is ours");
            theirs.set_nonblocking(true).expect("it is ours");
            let early = theirs.read(&mut [0]).map_err(|cause| cause.kind());
            assert_eq!(early, Err(io::ErrorKind::WouldBlock), "it may not begin yet");
            report.allow();
        });
        theirs.read_to_end(&mut read).expect("the other end is closed");
        assert_eq!(read.len(), 1);
    }

    #[test]
    fn closed_socket_without_a_reason_is_a_success() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(async {
            for (reason, read) in [("", None), ("no such file", Some("no such file".to_owned()))] {
                let (ours, mut theirs) = std::os::unix::net::UnixStream::pair().expect("a pair");
                let mut report = LaunchReport::new(ours).expect("it is ours");
                theirs.write_all(reason.as_bytes()).expect("it has room");
                drop(theirs);
                report.read().await;
                assert_eq!(report.finish(), read);
            }
        });
    }
}
