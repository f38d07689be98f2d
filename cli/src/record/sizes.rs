//! Sizes and times on the command line.

use std::time::Duration;

/// The smallest recording, and the smallest part of one: some chunks and the summary fit.
const BYTES_MIN: u64 = 64 << 10;

/// After this much a new file begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Split {
    Bytes(u64),
    Time(Duration),
}

/// Reads a number of bytes: `500M`, `2GiB`, `65536`.
pub(crate) fn bytes(text: &str) -> Result<u64, String> {
    let end = text.find(|letter: char| !letter.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    let shift = match unit {
        "" => 0,
        "K" | "KiB" => 10,
        "M" | "MiB" => 20,
        "G" | "GiB" => 30,
        "T" | "TiB" => 40,
        _ => return Err(format!("`{unit}` is no unit of bytes: write K, M, G or T, as in 500M")),
    };
    let number = number.parse::<u64>().ok().and_then(|number| number.checked_mul(1 << shift));
    number
        .filter(|bytes| *bytes >= BYTES_MIN)
        .ok_or_else(|| "write a number of at least 64K, as in 500M".to_owned())
}

/// Reads a time: `30s`, `5m`, `1h 30m`.
pub(crate) fn time(text: &str) -> Result<Duration, String> {
    let time =
        humantime::parse_duration(text).map_err(|why| format!("{why}; write a time as in 30s or 5m"))?;
    if time.is_zero() { Err("write a time above zero, as in 30s".to_owned()) } else { Ok(time) }
}

/// Reads a number of bytes or a time. `m` is minutes, `M` is MiB.
pub(crate) fn split(text: &str) -> Result<Split, String> {
    let is_bytes = text.ends_with(|letter: char| letter.is_ascii_digit() || "KMGTB".contains(letter));
    if is_bytes { bytes(text).map(Split::Bytes) } else { time(text).map(Split::Time) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_are_told_apart() {
        assert_eq!(split("500M"), Ok(Split::Bytes(500 << 20)));
        assert_eq!(split("5m"), Ok(Split::Time(Duration::from_secs(300))));
        assert_eq!(split("65536"), Ok(Split::Bytes(65_536)));
        assert_eq!((bytes("2GiB"), time("1h 30m")), (Ok(2 << 30), Ok(Duration::from_secs(5_400))));
    }

    #[test]
    fn fault_has_an_example() {
        for text in ["", "M", "1K", "99999999999T", "5X", "-1"] {
            let fault = bytes(text).unwrap_err();
            assert!(fault.contains("500M"), "{text}: {fault}");
        }
        for text in ["", "0s", "5 parsecs"] {
            let fault = time(text).unwrap_err();
            assert!(fault.contains("30s"), "{text}: {fault}");
        }
    }
}
