//! The files of the page, which are part of the program: no file is read from the disk, and none from another server.

/// A file of the page.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Asset {
    pub(crate) path: &'static str,
    pub(crate) content_type: &'static str,
    pub(crate) bytes: &'static [u8],
}

const HTML: &str = "text/html; charset=utf-8";
const STYLE: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

macro_rules! asset {
    ($path:literal, $content_type:expr, $file:literal) => {
        Asset { path: $path, content_type: $content_type, bytes: include_bytes!(concat!("../page/", $file)) }
    };
}

static ASSETS: [Asset; 14] = [
    asset!("/", HTML, "index.html"),
    asset!("/page.css", STYLE, "page.css"),
    asset!("/main.js", SCRIPT, "main.js"),
    asset!("/dom.js", SCRIPT, "dom.js"),
    asset!("/theme.js", SCRIPT, "theme.js"),
    asset!("/map.js", SCRIPT, "map.js"),
    asset!("/tables.js", SCRIPT, "tables.js"),
    asset!("/plots.js", SCRIPT, "plots.js"),
    asset!("/parameters.js", SCRIPT, "parameters.js"),
    asset!("/events.js", SCRIPT, "events.js"),
    asset!("/stop.js", SCRIPT, "stop.js"),
    asset!("/icon.svg", "image/svg+xml", "icon.svg"),
    asset!("/uPlot.js", SCRIPT, "uplot/uPlot.iife.min.js"),
    asset!("/uPlot.css", STYLE, "uplot/uPlot.min.css"),
];

/// Returns the file at this path of a request.
pub(crate) fn find(path: &str) -> Option<&'static Asset> {
    ASSETS.iter().find(|asset| asset.path == path)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(path: &str) -> &'static str {
        let asset = find(path).unwrap_or_else(|| panic!("{path} is missing"));
        std::str::from_utf8(asset.bytes).expect("it is text")
    }

    /// Returns the texts between quotes that follow `before`.
    fn quoted<'t>(text: &'t str, before: &str) -> Vec<&'t str> {
        let parts = text.split(before).skip(1);
        parts.filter_map(|part| part.split('"').next()).collect()
    }

    #[test]
    fn page_names_only_files_that_exist() {
        let page = text("/");
        let named = [quoted(page, " src=\""), quoted(page, " href=\"")].concat();
        assert!(named.len() > 3, "{named:?}");
        for path in named.into_iter().filter(|path| !path.starts_with('#')) {
            assert!(find(path).is_some() || path == "/metrics", "{path}");
        }
        for asset in ASSETS.iter().filter(|asset| asset.content_type == SCRIPT) {
            for path in quoted(text(asset.path), " from \".") {
                assert!(find(path).is_some(), "{}: {path}", asset.path);
            }
        }
    }

    /// The policy of the page forbids scripts and styles in the document.
    #[test]
    fn page_has_no_inline_parts_and_no_other_server() {
        let page = text("/");
        assert!(!page.contains("<style") && !page.contains(" style=") && !page.contains(" onclick"));
        assert!(page.split("<script").skip(1).all(|script| script.contains(" src=\"/")));
        for asset in ASSETS.iter().filter(|asset| !asset.path.starts_with("/uPlot")) {
            let text = text(asset.path).replace("http://www.w3.org/", "");
            assert!(!text.contains("http://") && !text.contains("https://"), "{}", asset.path);
        }
    }
}
