//! Users that the kernel cannot name: those of the host that this process's user namespace does not map.

use std::{fs, sync::OnceLock};

/// Number of users that a user namespace can map: all but the number that means none. Source: user_namespaces(7).
const ALL: u64 = u32::MAX as u64;

/// Returns the user number (`overflowuid`) that the kernel reports for each user that this user namespace
/// does not map; `None` if the namespace maps all users, as that of the host does, or if the kernel has no
/// user namespaces.
///
/// A peer with this number may be any of these users, so it is nobody's proof.
pub fn unmapped_user() -> Option<u32> {
    static USER: OnceLock<Option<u32>> = OnceLock::new();
    *USER.get_or_init(|| {
        let read = |path| fs::read_to_string(path).ok();
        unmapped(&read("/proc/self/uid_map")?, &read("/proc/sys/kernel/overflowuid")?)
    })
}

/// Each line of `uid_map` has the first user inside, the first user outside, and a count.
fn unmapped(uid_map: &str, overflow: &str) -> Option<u32> {
    let count = |line: &str| line.split_whitespace().nth(2)?.parse::<u64>().ok();
    let mapped: u64 = uid_map.lines().filter_map(count).fold(0, u64::saturating_add);
    if mapped >= ALL { None } else { overflow.trim().parse().ok() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn partial_mapping_leaves_users_unmapped() {
        let whole = "         0          0 4294967295\n";
        assert_eq!(unmapped(whole, "65534\n"), None);
        let in_two = "0 0 65536\n65536 65536 4294901759\n";
        assert_eq!(unmapped(in_two, "65534\n"), None);
        for of_a_part in ["0 100000 65536\n", "65534 0 1\n", ""] {
            assert_eq!(unmapped(of_a_part, "65534\n"), Some(65_534), "{of_a_part:?}");
        }
        assert_eq!(unmapped("0 0 1", "no number"), None);
    }
}
