//! The key expressions of the link.
//!
//! | key | content |
//! | --- | --- |
//! | `sinew/{project}/to/{target}/{source}` | a put with a packet; `target` is an address, or `all` |
//! | `sinew/{project}/host/{address}/{instance}` | the liveliness token of a host |
//!
//! The source is the last part of a key. So a router's access list can allow each host its own source only.

use std::{fmt::Write as _, net::Ipv4Addr};

use crate::{Instance, Target};

const ALL: &str = "all";

/// Returns the key of a put with a packet.
///
/// # Examples
///
/// ```
/// use sinew_zenoh_link::{Target, key};
///
/// let [a, b] = [1, 2].map(|last| [10, 99, 0, last].into());
/// assert_eq!(key::put("leg", Target::Host(b), a), "sinew/leg/to/10.99.0.2/10.99.0.1");
/// assert_eq!(key::parse_put("sinew/leg/to/10.99.0.2/10.99.0.1"), Some((Target::Host(b), a)));
/// ```
#[must_use]
pub fn put(project: &str, target: Target, source: Ipv4Addr) -> String {
    format!("{}/{source}", put_prefix(project, target))
}

/// Returns the key expression of all puts to a target.
#[must_use]
pub fn puts_to(project: &str, target: Target) -> String {
    format!("{}/*", put_prefix(project, target))
}

/// Returns the key of a host's liveliness token.
#[must_use]
pub fn token(project: &str, address: Ipv4Addr, instance: Instance) -> String {
    format!("sinew/{}/host/{address}/{instance}", escaped(project))
}

/// Returns the key expression of all hosts' tokens.
#[must_use]
pub fn tokens(project: &str) -> String {
    format!("sinew/{}/host/*/*", escaped(project))
}

/// Returns the target and the source of a put, or `None` if the key is no key of the link.
#[must_use]
pub fn parse_put(key: &str) -> Option<(Target, Ipv4Addr)> {
    let (target, source) = last_two(key, "to")?;
    let target = if target == ALL { Target::All } else { Target::Host(target.parse().ok()?) };
    Some((target, source.parse().ok()?))
}

/// Returns the address and the instance of a token, or `None` if the key is no key of a token.
#[must_use]
pub fn parse_token(key: &str) -> Option<(Ipv4Addr, Instance)> {
    let (address, digits) = last_two(key, "host")?;
    let is_instance = digits.len() == 32 && digits.bytes().all(|digit| digit.is_ascii_hexdigit());
    let number = u128::from_str_radix(digits, 16).ok().filter(|_| is_instance)?;
    Some((address.parse().ok()?, Instance(number.to_be_bytes())))
}

fn put_prefix(project: &str, target: Target) -> String {
    let project = escaped(project);
    match target {
        Target::Host(address) => format!("sinew/{project}/to/{address}"),
        Target::All => format!("sinew/{project}/to/{ALL}"),
    }
}

/// Returns the two parts behind `kind`. The project is that of the subscription.
fn last_two<'a>(key: &'a str, kind: &str) -> Option<(&'a str, &'a str)> {
    let mut parts = key.rsplit('/');
    let (last, before) = (parts.next()?, parts.next()?);
    (parts.next()? == kind).then_some((before, last))
}

/// Returns the project's name as one part of a key. Zenoh gives `*`, `$`, `?`, `#` and `/` a meaning, and `@` as
/// a first character.
fn escaped(project: &str) -> String {
    let mut part = String::with_capacity(project.len());
    for character in project.chars() {
        if character.is_alphanumeric() || matches!(character, '-' | '_' | '.') {
            part.push(character);
        } else {
            for byte in character.encode_utf8(&mut [0; 4]).bytes() {
                write!(part, "%{byte:02x}").expect("a string takes any text");
            }
        }
    }
    part
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: Ipv4Addr = Ipv4Addr::new(10, 99, 0, 1);

    #[test]
    fn keys_are_read_as_they_were_written() {
        for target in [Target::All, Target::Host(A)] {
            assert_eq!(parse_put(&put("leg", target, A)), Some((target, A)));
        }
        for instance in [Instance([0; 16]), Instance([0xab; 16])] {
            assert_eq!(parse_token(&token("leg", A, instance)), Some((A, instance)));
        }
    }

    #[test]
    fn project_is_one_part_of_a_key() {
        assert_eq!(token("a/b *", A, Instance([0x1f; 16])).split('/').count(), 5);
        assert_eq!(tokens("a/b"), "sinew/a%2fb/host/*/*");
        assert_eq!(tokens("büro-1"), "sinew/büro-1/host/*/*");
        assert_ne!(tokens("a/b"), tokens("a%2fb"), "no two projects share a key");
    }

    #[test]
    fn other_keys_are_refused() {
        for key in ["", "/", "sinew", "sinew/leg/to/10.99.0.1", "a/to/all/10.99.0.1.7", "a/by/all/10.99.0.1"]
        {
            assert_eq!(parse_put(key), None, "{key}");
        }
        for key in
            ["sinew/leg/host/10.99.0.1/12", "sinew/leg/host/10.99.0.1/+0000000000000000000000000000001"]
        {
            assert_eq!(parse_token(key), None, "{key}");
        }
    }
}
