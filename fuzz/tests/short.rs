//! Short runs of all fuzz targets.

use fuzz::{corpus, run, targets};

/// Returns the number of cases of a target; those that compile or step a scene take milliseconds each.
fn cases(name: &str) -> u64 {
    match name {
        "conditions" | "data" | "scenario" | "obstacles" | "mjcf" | "airframe" => 150,
        "flight" | "mesh" => 300,
        _ => 1000,
    }
}

#[test]
fn no_target_panics_on_its_corpus_or_its_mutations() {
    for target in &targets::ALL {
        let corpus = corpus(target).unwrap();
        assert!(!corpus.is_empty(), "{}", target.name);
        let max = cases(target.name);
        let report = run(target, &corpus, 17, |case, _| case < max);
        if let Some(finding) = report.finding {
            let input = String::from_utf8_lossy(&finding.input).into_owned();
            panic!("{}: case {:?}: {}\n{input}", target.name, finding.case, finding.message);
        }
        assert_eq!(report.cases, max);
        // a run that only produces rejections, or only one kind of them, tests nothing
        assert!(report.accepted > 0 && report.answers > 3, "{}: {report:?}", target.name);
    }
}
