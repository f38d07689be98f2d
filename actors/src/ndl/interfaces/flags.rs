//! What the kernel says of an IPv6 address, beside that the host has it.

use std::collections::BTreeMap;

use crate::ndl::address::LocalAddress;

/// What is to be known before an address is used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::ndl) struct Flags {
    /// The kernel still asks whether another host has it (RFC 4862, section 5.4), and lets nobody bind it.
    pub(in crate::ndl) is_tentative: bool,
    /// Another host has it: nobody can use it here.
    pub(in crate::ndl) is_duplicate: bool,
    /// The host changes it now and then (RFC 8981), or gives it up soon (RFC 4862, section 5.5.4).
    pub(in crate::ndl) is_temporary: bool,
}

/// What the kernel says of each, where it says it: nothing is known of the others.
#[cfg(target_os = "linux")]
pub(super) fn look() -> BTreeMap<LocalAddress, Flags> {
    use std::{fs::File, io::Read as _};

    /// Of the network namespace of this thread, which may be another one than that of the process.
    const PATH: &str = "/proc/thread-self/net/if_inet6";
    /// 1,024 lines and more.
    const BYTES_MAX: u64 = 64 << 10;

    let mut text = String::new();
    let read = File::open(PATH).and_then(|file| file.take(BYTES_MAX).read_to_string(&mut text));
    // Where it cannot be read, what cannot be bound is tried again each second.
    if read.is_ok() { of(&text) } else { BTreeMap::new() }
}

/// Nothing is said of any.
#[cfg(not(target_os = "linux"))]
pub(super) const fn look() -> BTreeMap<LocalAddress, Flags> {
    BTreeMap::new()
}

/// Lines as in `fe8000000000000000fc00fffe000001 04 40 20 80     eth0`: the address, and in hexadecimal digits the interface's number, the
/// prefix's length, the scope, and flags (`linux/if_addr.h`).
#[cfg(target_os = "linux")]
fn of(text: &str) -> BTreeMap<LocalAddress, Flags> {
    const TEMPORARY: u32 = 0x01;
    const OPTIMISTIC: u32 = 0x04;
    const DUPLICATE: u32 = 0x08;
    const DEPRECATED: u32 = 0x20;
    const TENTATIVE: u32 = 0x40;
    let line = |line: &str| {
        let words: Vec<_> = line.split_ascii_whitespace().collect();
        let [address, interface, _, _, flags, ..] = words[..] else { return None };
        let number = |digits: &str| u32::from_str_radix(digits, 16).ok();
        let ip = std::net::Ipv6Addr::from_bits(u128::from_str_radix(address, 16).ok()?);
        let (interface, flags) = (number(interface)?, number(flags)?);
        let has = |flag: u32| flags & flag != 0;
        let said = Flags {
            is_tentative: has(TENTATIVE) && !has(OPTIMISTIC) && !has(DUPLICATE),
            is_duplicate: has(DUPLICATE),
            is_temporary: has(TEMPORARY) || has(DEPRECATED),
        };
        Some((LocalAddress { ip: ip.into(), interface }, said))
    };
    text.lines().filter_map(line).collect()
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn each_line_says_what_is_to_be_known_of_one_address() {
        let text = "00000000000000000000000000000001 01 80 10 80       lo\n\
                    fe8000000000000000fc00fffe000001 0a 40 20 c0     eth0\n\
                    fd000000000000000000000000000002 0a 40 00 48     eth0\n\
                    20010db8000000000000000000000001 0a 40 00 01     eth0\n\
                    20010db8000000000000000000000002 0a 40 00 44     eth0\n\
                    not a line\n";
        let said = of(text);
        let flags = |ip: &str, interface| said[&LocalAddress { ip: ip.parse().unwrap(), interface }];
        assert_eq!(said.len(), 5);
        assert_eq!(flags("::1", 1), Flags::default());
        assert_eq!(flags("fe80::fc:ff:fe00:1", 10), Flags { is_tentative: true, ..Flags::default() });
        assert_eq!(flags("fd00::2", 10), Flags { is_duplicate: true, ..Flags::default() });
        assert_eq!(flags("2001:db8::1", 10), Flags { is_temporary: true, ..Flags::default() });
        assert_eq!(flags("2001:db8::2", 10), Flags::default(), "an optimistic one may be bound");
    }

    proptest! {
        #[test]
        fn any_text_is_read(text in r"([0-9a-f]{0,34} ?){0,6}\n?|\PC{0,80}") {
            let _ = of(&text);
        }
    }
}
