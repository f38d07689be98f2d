//! The stored figures: instructions of a round trip, for each path, by compiler, C library and profile.

use std::{collections::BTreeMap, fs, process::Command};

/// Growth of a path that is reported as an error, in percent of its stored figure.
const GROWTH_MAX: u64 = 3;

const FILE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/figures.json");

/// The figures of one key, by the names of the paths.
pub(crate) type Figures = BTreeMap<String, u64>;

/// How a count stands to its stored figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    NotStored,
    Same,
    /// By [`GROWTH_MAX`] or more.
    Grown,
    /// By as much.
    Shrunk,
}

impl Verdict {
    pub(crate) const fn of(count: u64, stored: Option<u64>) -> Self {
        let Some(stored) = stored else { return Self::NotStored };
        if count * 100 >= stored * (100 + GROWTH_MAX) {
            Self::Grown
        } else if count * 100 <= stored * (100 - GROWTH_MAX) {
            Self::Shrunk
        } else {
            Self::Same
        }
    }

    pub(crate) const fn words(self) -> &'static str {
        match self {
            Self::NotStored => "not stored",
            Self::Same => "",
            Self::Grown => "GROWN: make it shorter, or store the figures with --store and say why",
            Self::Shrunk => "shorter: store the figures with --store",
        }
    }
}

/// The change in percent, as text.
pub(crate) fn change(count: u64, stored: Option<u64>) -> String {
    stored
        .map_or_else(String::new, |stored| format!("{:+.1} %", 100.0 * (count as f64 / stored as f64 - 1.0)))
}

/// The compiler, the C library and the profile.
pub(crate) fn key() -> Result<String, String> {
    let output = Command::new("ldd").arg("--version").output();
    let output =
        output.map_err(|why| format!("`ldd --version`, which names the C library, does not run: {why}"))?;
    let text = String::from_utf8_lossy(&output.stdout);
    // "ldd (Debian GLIBC 2.36-9+deb12u14) 2.36"
    let version = text.lines().next().and_then(|line| line.rsplit(' ').next()).unwrap_or("unknown");
    let profile = if cfg!(debug_assertions) { "debug" } else { "release" };
    let architecture = std::env::consts::ARCH;
    Ok(format!("{}, libc {version}, {architecture}, {profile}", env!("SINEW_RUSTC")))
}

fn read_all() -> Result<BTreeMap<String, Figures>, String> {
    let text = fs::read_to_string(FILE).map_err(|why| format!("{FILE}: {why}"))?;
    serde_json::from_str(&text).map_err(|why| format!("{FILE}: {why}"))
}

/// The figures of this key; none if it is unknown.
pub(crate) fn read(key: &str) -> Result<Figures, String> {
    Ok(read_all()?.remove(key).unwrap_or_default())
}

/// Stores the figures of this key.
pub(crate) fn write(key: &str, figures: &Figures) -> Result<(), String> {
    let mut all = read_all()?;
    all.insert(key.to_owned(), figures.clone());
    let text = serde_json::to_string_pretty(&all).map_err(|why| why.to_string())?;
    fs::write(FILE, text + "\n").map_err(|why| format!("{FILE}: {why}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn count_may_differ_by_three_percent_from_stored_figure() {
        let of = |count| Verdict::of(count, Some(1_000));
        assert_eq!([of(1_029), of(1_030)], [Verdict::Same, Verdict::Grown]);
        assert_eq!([of(971), of(970)], [Verdict::Same, Verdict::Shrunk]);
        assert_eq!(Verdict::of(1, None), Verdict::NotStored);
    }

    #[test]
    fn stored_figures_are_read() {
        read_all().expect("the file is whole");
    }
}
