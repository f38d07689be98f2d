//! The header and the README in the repository match the source.

use std::path::Path;

/// Writes the header instead of comparing it.
const BLESS: &str = "SINEW_BLESS";

#[test]
fn header_matches_the_source() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let path = package.join("include/sinew.h");
    let config = cbindgen::Config::from_file(package.join("cbindgen.toml")).unwrap();
    let mut header = Vec::new();
    cbindgen::Builder::new().with_crate(package).with_config(config).generate().unwrap().write(&mut header);
    let header = String::from_utf8(header).unwrap();
    if std::env::var_os(BLESS).is_some() {
        std::fs::write(&path, &header).unwrap();
    }
    let checked_in = std::fs::read_to_string(&path).unwrap_or_default();
    let differs = header.lines().zip(checked_in.lines()).find(|(generated, stored)| generated != stored);
    assert!(
        header == checked_in,
        "include/sinew.h differs from the source (first difference: {differs:?}); generate it by \
         `{BLESS}=1 cargo test -p sinew-c --test header`"
    );
}

#[test]
fn readme_shows_the_example_verbatim() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let readme = std::fs::read_to_string(package.join("README.md")).unwrap();
    let example = std::fs::read_to_string(package.join("examples/drive.cpp")).unwrap();
    assert!(readme.contains(&format!("```cpp\n{example}```")), "README.md shows another examples/drive.cpp");
    assert!(example.lines().count() <= 30, "it is called a program of 30 lines");
}

#[test]
fn api_page_shows_the_example_verbatim() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    let page = std::fs::read_to_string(package.join("../../actors/client/src/lib.rs")).unwrap();
    let example = std::fs::read_to_string(package.join("examples/hello.c")).unwrap();
    let shown = example.lines().map(|line| format!("//! {line}").trim_end().to_owned() + "\n");
    assert!(
        page.contains(&shown.collect::<String>()),
        "actors/client/src/lib.rs shows another examples/hello.c"
    );
}

#[test]
fn every_function_documents_its_threads() {
    let header =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("include/sinew.h")).unwrap();
    let mut functions = 0;
    let mut words = String::new();
    for line in header.lines() {
        if line.starts_with("/**") {
            words.clear();
        }
        words.push_str(line.trim_start_matches(" *"));
        // The end of a declaration, or its first line; types have none of these.
        if line.contains(" sinew_") && line.contains('(') && !line.starts_with([' ', '/', '#']) {
            functions += 1;
            let threads = ["Any thread", "The endpoint's thread"];
            let flat = words.split_whitespace().collect::<Vec<_>>().join(" ");
            assert!(threads.iter().any(|thread| flat.contains(thread)), "which thread? {line}");
        }
    }
    assert!(functions > 25, "{functions} functions were found");
}
