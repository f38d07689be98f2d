//! The kernel's account of a thread's CPU use.

/// The state of a thread, according to the kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Condition {
    /// The thread runs, or waits for a CPU.
    Runnable,
    /// The thread is blocked.
    Blocked,
    /// The thread was stopped by a signal or a debugger.
    Stopped,
}

/// The CPU use of a thread since its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sample {
    /// Nanoseconds on a CPU. The kernel updates it at each tick and each switch.
    pub(super) ran: u64,
    /// Nanoseconds of waiting for a CPU; the present wait is added when it ends.
    pub(super) waited: u64,
    pub(super) condition: Condition,
}

/// Returns the CPU use of the thread `tid` of this process; `None` if it has ended, or the kernel keeps no
/// account of it.
pub(super) fn sample(tid: i32) -> Option<Sample> {
    parse(&read(tid, "schedstat")?, &read(tid, "stat")?)
}

/// Returns the [time of waiting](Sample::waited) of the thread `tid` alone, which costs one file.
pub(super) fn waited(tid: i32) -> Option<u64> {
    parse_times(&read(tid, "schedstat")?).map(|(_, waited)| waited)
}

fn read(tid: i32, file: &str) -> Option<String> {
    std::fs::read_to_string(format!("/proc/self/task/{tid}/{file}")).ok()
}

fn parse_times(schedstat: &str) -> Option<(u64, u64)> {
    let mut numbers = schedstat.split_ascii_whitespace().map_while(|word| word.parse().ok());
    Some((numbers.next()?, numbers.next()?))
}

fn parse(schedstat: &str, stat: &str) -> Option<Sample> {
    let (ran, waited) = parse_times(schedstat)?;
    // The name before it is in brackets and may itself have brackets and spaces.
    let (_, after_name) = stat.rsplit_once(')')?;
    let condition = match after_name.trim_start().bytes().next()? {
        b'R' => Condition::Runnable,
        b'T' | b't' => Condition::Stopped,
        _ => Condition::Blocked,
    };
    Some(Sample { ran, waited, condition })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thread_with_a_malicious_name_is_parsed() {
        let stat = "123 (evil) R (x) S 1 123 123 0";
        let sample = Sample { ran: 7, waited: 9, condition: Condition::Blocked };
        assert_eq!(parse("7 9 3\n", stat), Some(sample));
    }

    #[test]
    fn invalid_account_is_none() {
        assert_eq!(parse("", "1 (a) R"), None);
        assert_eq!(parse("1 2 3", "nonsense"), None);
        assert_eq!(parse("1 2 3", "1 (a"), None);
    }

    #[test]
    fn calling_thread_is_runnable() {
        let tid = rustix::thread::gettid().as_raw_nonzero().get();
        let known = waited(tid);
        let sample = sample(tid);
        assert_eq!(sample.map(|sample| sample.condition), Some(Condition::Runnable));
        assert!(known.is_some() && known <= sample.map(|sample| sample.waited));
    }
}
