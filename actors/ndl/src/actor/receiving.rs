//! Reads datagrams, and limits the rate of the reads.

use std::{io, net::SocketAddr, rc::Rc, time::Duration};

use sinew_model::rate_limiter::{Rate, RateLimiter};
use sinew_runtime::time::Time;
use sinew_security::node_security::SEAL_LEN;

use super::Shell;
use crate::{
    core::{Cast, Place},
    datagram::{DATAGRAM_MAX, is_frame, maker_of},
};

/// Pause after a failed read, so that a socket with a permanent failure does not use the whole thread.
const READ_ERROR_BACKOFF: Duration = Duration::from_millis(10);
/// Maximum number of datagrams read without a pause. The pause leaves CPU time to other threads during a
/// flood, for any priority of this thread and any time to check a datagram.
const AT_ONCE: u32 = 128;
/// Time after which one more may be read. Sources at or below this rate are never delayed. A thousand nodes
/// that query each other each 50 ms stay below it.
const ONE_MORE: Duration = Duration::from_nanos(1_000_000 / 64);
/// Cost of a datagram that is not the project's, relative to one of the project. Of a flood 32 are read at
/// once, and 16 in each millisecond, by a thread that may delay all others.
const FOREIGN_IS_WORTH: u32 = 4;
/// Time between two checks whether the pause is over.
const PAUSE: Duration = Duration::from_millis(1);

/// The refusal of an unsealed datagram at a node that requires seals. Any host can send one, so the text
/// never advises to remove this node's keys.
const UNSEALED: &str = "it has no seal, and this node has keys; if that node is of this robot, give it keys: `sinew keys issue NAME --keys DIR`, and \
                        set security.keys there";

/// The rate of reads from all sockets, which one thread reads. The limit does not depend on an empty socket:
/// a flood slightly slower than this thread would otherwise never let it pause.
#[derive(Debug)]
pub(super) struct ReadLimiter(RateLimiter);

impl ReadLimiter {
    pub(super) const fn new() -> Self {
        Self(RateLimiter::new(Rate::new(ONE_MORE, AT_ONCE)))
    }

    /// Counts a read at `now`. Returns whether a pause is due.
    fn on_read(&mut self, now: Time, worth: u32) -> bool {
        self.0.charge(now, ONE_MORE * worth, Duration::MAX);
        self.must_pause(now)
    }

    /// Returns whether a pause is still due. Reads from other sockets count, too.
    fn must_pause(&self, now: Time) -> bool {
        !self.0.delay(now).is_zero()
    }
}

/// Reads datagrams while this instance is the current one. Answers are sent from here.
pub(super) async fn receive(
    shell: Rc<Shell>,
    socket: tokio::net::UdpSocket,
    (here, cast): (SocketAddr, Cast),
) {
    // One byte more than the maximum: a longer datagram is detected, not truncated.
    let mut buffer = [0; DATAGRAM_MAX + SEAL_LEN + 1];
    loop {
        let received = match socket.try_recv_from(&mut buffer) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => socket.recv_from(&mut buffer).await,
            received => received,
        };
        match received {
            Ok((length, there)) => {
                let bytes = shell.unsealed(there, &buffer[..length]);
                let worth = if bytes.is_some() { 1 } else { FOREIGN_IS_WORTH };
                if let Some(bytes) = bytes
                    && !shell.feed(|core, now| core.receive(now, Place { there, here }, cast, bytes))
                {
                    return;
                }
                let mut must_pause = shell.reads.borrow_mut().on_read(Time::now(), worth);
                while must_pause {
                    tokio::time::sleep(PAUSE).await;
                    must_pause = shell.reads.borrow().must_pause(Time::now());
                }
            }
            Err(error) => {
                shell.refusals.count(Time::now(), "NDL socket not readable", &error);
                tokio::time::sleep(READ_ERROR_BACKOFF).await;
            }
        }
    }
}

impl Shell {
    /// Returns the datagram from `from`, if this node has no keys or a node of its project made it. spec: NDL-1.3
    fn unsealed<'a>(&self, from: SocketAddr, bytes: &'a [u8]) -> Option<&'a [u8]> {
        let Some(secured) = self.state.security.secured.get() else { return Some(bytes) };
        let now = Time::now();
        let refused = |why: &&str| {
            // A node without keys sends this form, and so does an impostor.
            let why = if is_frame(bytes) { UNSEALED } else { *why };
            self.refusals.count(
                now,
                "NDL datagram not of this project's keys",
                &format_args!("{from}: {why}"),
            );
        };
        secured.unseal(now, bytes, maker_of).inspect_err(refused).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEGIN: Time = Time::from_nanos(1_000_000_000);

    #[test]
    fn slow_flood_gets_no_more_thread_time() {
        for micros in [1, 5, 20, 60] {
            let (mut reads, mut now, mut read) = (ReadLimiter::new(), BEGIN, 0);
            let end = now + Duration::from_secs(1);
            while now < end {
                now = now + Duration::from_micros(micros);
                read += 1;
                if reads.on_read(now, FOREIGN_IS_WORTH) {
                    now = now + PAUSE;
                }
            }
            let at_once = AT_ONCE / FOREIGN_IS_WORTH;
            assert!(read <= 16_000 + at_once, "{read} of those that come each {micros} us");
            assert!(read >= 12_000, "{read} of those that come each {micros} us");
        }
    }

    #[test]
    fn flood_on_several_sockets_gets_no_more_time() {
        const SOCKETS: usize = 40;
        let (mut reads, mut now, mut read) = (ReadLimiter::new(), BEGIN, 0);
        let mut rests = [false; SOCKETS];
        let end = now + Duration::from_secs(1);
        while now < end {
            for rests in &mut rests {
                *rests = *rests && reads.must_pause(now);
                while !*rests {
                    now = now + Duration::from_micros(5);
                    read += 1;
                    *rests = reads.on_read(now, FOREIGN_IS_WORTH);
                }
            }
            now = now + PAUSE;
        }
        // Initially each socket has waited for one datagram already, which it reads in any case.
        let at_once = AT_ONCE / FOREIGN_IS_WORTH + SOCKETS as u32;
        assert!(read <= 16_000 + at_once, "{read}");
        assert!(read >= 12_000, "{read}");
    }

    #[test]
    fn conforming_datagrams_of_the_project_are_never_delayed() {
        // 64 nodes that query each other each 10 ms, all at once; 640 that do each 20 ms, evenly.
        for (at_once, each) in [(2 * 63, Duration::from_millis(10)), (1, Duration::from_nanos(15_640))] {
            let (mut reads, mut now) = (ReadLimiter::new(), BEGIN);
            for _ in 0..1_000 {
                now = now + each;
                assert!((0..at_once).all(|_| !reads.on_read(now, 1)), "{at_once} each {each:?}");
            }
        }
    }
}
