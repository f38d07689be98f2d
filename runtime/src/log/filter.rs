//! Which events the default log writes. Pure.

use tracing::{Level, level_filters::LevelFilter};

/// The crates whose events these are begin with this.
const OWN: &str = "sinew";

/// What `SINEW_LOG` says: `warn`, `info,sinew::gncl=debug`, `off`. The syntax is that of `EnvFilter` of `tracing-subscriber`, without
/// its spans and fields, of which there are none here.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Filter {
    /// Beginnings of targets, the longest first, and the most that is wanted of each.
    targets: Vec<(String, LevelFilter)>,
    /// Of all others.
    rest: LevelFilter,
}

impl Filter {
    /// Reads directives. Those that cannot be read are left out. Where none is about Sinew, everything up to `usual` is wanted:
    /// `RUST_LOG` may be set for other parts of the program alone.
    pub(super) fn read(said: &str, usual: LevelFilter) -> Self {
        let (mut targets, mut rest) = (Vec::new(), None);
        for directive in said.split(',').map(str::trim).filter(|directive| !directive.is_empty()) {
            match directive.split_once('=') {
                Some((target, level)) => {
                    // `sinew[span{field}]=info` is about spans.
                    if let (Ok(level), false) = (level.trim().parse(), target.contains('[')) {
                        targets.push((target.trim().to_owned(), level));
                    }
                }
                None => match directive.parse() {
                    Ok(level) => rest = Some(level),
                    Err(_) => targets.push((directive.to_owned(), LevelFilter::TRACE)),
                },
            }
        }
        let is_ours = |target: &str| target.starts_with(OWN) || OWN.starts_with(target);
        let is_about_us = targets.iter().any(|(target, _)| is_ours(target));
        // As with `EnvFilter`: who names targets wants those.
        let others = if is_about_us { LevelFilter::OFF } else { usual };
        targets.sort_by_key(|(target, _)| std::cmp::Reverse(target.len()));
        Self { targets, rest: rest.unwrap_or(others) }
    }

    /// Whether an event of this level is written that comes from `target`.
    pub(super) fn wants(&self, target: &str, level: Level) -> bool {
        let known = self.targets.iter().find(|(start, _)| target.starts_with(start));
        target.starts_with(OWN) && level <= known.map_or(self.rest, |(_, most)| *most)
    }

    /// The most that is written of anything.
    pub(super) fn most(&self) -> LevelFilter {
        self.targets.iter().map(|(_, most)| *most).fold(self.rest, LevelFilter::max)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The lowest level that is written of GNCL, NDL, and the runtime.
    fn levels(said: &str) -> [LevelFilter; 3] {
        let filter = Filter::read(said, LevelFilter::INFO);
        ["sinew::gncl::actor", "sinew::ndl", "sinew_runtime::app"].map(|target| {
            let levels = [Level::TRACE, Level::DEBUG, Level::INFO, Level::WARN, Level::ERROR];
            let most = levels.into_iter().find(|level| filter.wants(target, *level));
            most.map_or(LevelFilter::OFF, LevelFilter::from_level)
        })
    }

    #[test]
    fn a_level_counts_for_all_and_a_longer_target_before_a_shorter_one() {
        use LevelFilter as L;
        for (said, wanted) in [
            ("warn", [L::WARN; 3]),
            ("OFF", [L::OFF; 3]),
            ("warn,sinew::gncl=debug", [L::DEBUG, L::WARN, L::WARN]),
            (" sinew=error , sinew::gncl=trace ", [L::TRACE, L::ERROR, L::ERROR]),
            ("sinew::gncl=debug", [L::DEBUG, L::OFF, L::OFF]),
            ("sinew::gncl", [L::TRACE, L::OFF, L::OFF]),
            // Nothing about Sinew, or nothing that can be read.
            ("my_robot=debug", [L::INFO; 3]),
            ("sinew[span]=debug,sinew=verbose,,", [L::INFO; 3]),
            ("my_robot=debug,error", [L::ERROR; 3]),
        ] {
            assert_eq!(levels(said), wanted, "{said}");
        }
    }

    #[test]
    fn events_of_other_crates_are_not_written() {
        assert!(!Filter::read("trace", LevelFilter::INFO).wants("my_robot", Level::ERROR));
        assert_eq!(Filter::read("warn,sinew::gncl=debug", LevelFilter::INFO).most(), LevelFilter::DEBUG);
    }
}
