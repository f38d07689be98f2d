//! Notifications for systemd (sd_notify(3)): plain datagrams to the socket that it names.

use std::{
    ffi::{OsStr, OsString},
    io,
    os::{
        linux::net::SocketAddrExt as _,
        unix::net::{SocketAddr, UnixDatagram},
    },
    time::Duration,
};

/// Notifications within the time that systemd's watchdog allows: one that is late does not end the node.
const FEEDS: u32 = 3;
/// Shortest interval between two of them.
const PERIOD_MIN: Duration = Duration::from_millis(1);

/// Sends notifications. Without systemd it does nothing.
#[derive(Debug)]
pub(crate) struct Notifier {
    socket: Option<(UnixDatagram, SocketAddr)>,
    period: Option<Duration>,
    /// Whether a failure was logged.
    has_failed: bool,
}

impl Notifier {
    /// Reads the environment of this process.
    pub(crate) fn of_this_process() -> Self {
        let read = |name: &str| std::env::var_os(name);
        Self::of(read("NOTIFY_SOCKET"), read("WATCHDOG_USEC"), read("WATCHDOG_PID"), std::process::id())
    }

    /// Reads the variables that systemd sets: the socket, the time of its watchdog in microseconds, and the process
    /// that the watchdog is for.
    fn of(socket: Option<OsString>, micros: Option<OsString>, process: Option<OsString>, own: u32) -> Self {
        let mut notifier = Self { socket: None, period: None, has_failed: false };
        let Some(path) = socket.filter(|path| !path.is_empty()) else { return notifier };
        match open(&path) {
            Ok(opened) => notifier.socket = Some(opened),
            Err(error) => notifier.failed(&error),
        }
        let number = |text: OsString| text.to_str().and_then(|text| text.parse::<u64>().ok());
        let is_own = process.is_none_or(|process| number(process) == Some(own.into()));
        let micros = micros.filter(|_| is_own).and_then(number).filter(|micros| *micros > 0);
        notifier.period = micros.map(|micros| (Duration::from_micros(micros) / FEEDS).max(PERIOD_MIN));
        notifier
    }

    /// Returns the interval at which the watchdog is to be fed; `None`: there is none.
    pub(crate) fn period(&self) -> Option<Duration> {
        self.period.filter(|_| self.socket.is_some())
    }

    /// Sends a notification, without waiting. A failure never ends the node.
    pub(crate) fn notify(&mut self, state: &str) {
        let Some((socket, address)) = &self.socket else { return };
        if let Err(error) = socket.send_to_addr(state.as_bytes(), address) {
            self.failed(&error);
        }
    }

    fn failed(&mut self, error: &io::Error) {
        if !std::mem::replace(&mut self.has_failed, true) {
            let remedy =
                "check NotifyAccess= of the unit, and that its socket is not hidden from the process";
            sinew_runtime::log::warn!(%error, remedy, "systemd gets no notification");
        }
    }
}

fn open(path: &OsStr) -> io::Result<(UnixDatagram, SocketAddr)> {
    let address = match path.as_encoded_bytes() {
        [b'@', name @ ..] => SocketAddr::from_abstract_name(name)?,
        _ => SocketAddr::from_pathname(path)?,
    };
    let socket = UnixDatagram::unbound()?;
    // The root never waits for systemd.
    socket.set_nonblocking(true)?;
    Ok((socket, address))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(socket: &str, micros: &str, process: Option<&str>) -> Notifier {
        let text = |text: &str| Some(OsString::from(text));
        Notifier::of(text(socket), text(micros), process.map(OsString::from), 7)
    }

    /// A socket in the abstract namespace, for this test alone, and its name in the variable.
    fn receiver(name: &str) -> (UnixDatagram, String) {
        let name = format!("sinew-test-{}-{name}", std::process::id());
        let address = SocketAddr::from_abstract_name(&name).expect("it is short");
        (UnixDatagram::bind_addr(&address).expect("the name is free"), format!("@{name}"))
    }

    #[test]
    fn notification_arrives_as_it_is() {
        let (receiver, name) = receiver("arrives");
        of(&name, "3000000", None).notify("READY=1");
        let mut text = [0; 64];
        let length = receiver.recv(&mut text).expect("it was sent before");
        assert_eq!(&text[..length], b"READY=1");
    }

    #[test]
    fn watchdog_of_this_process_is_fed_in_time() {
        let (_receiver, name) = receiver("fed");
        let second = Some(Duration::from_secs(1));
        assert_eq!(of(&name, "3000000", None).period(), second);
        assert_eq!(of(&name, "3000000", Some("7")).period(), second);
        assert_eq!(of(&name, "3000000", Some("8")).period(), None, "it is for another process");
        assert_eq!(of(&name, "nonsense", None).period(), None);
        assert_eq!(of(&name, "1", None).period(), Some(PERIOD_MIN));
    }

    #[test]
    fn process_without_systemd_notifies_nothing() {
        for mut notifier in [Notifier::of(None, None, None, 7), of("", "3000000", None)] {
            notifier.notify("READY=1");
            assert!(notifier.period().is_none() && !notifier.has_failed);
        }
        let mut gone = of("/none/at/all", "3000000", None);
        gone.notify("READY=1");
        assert!(gone.has_failed);
    }
}
