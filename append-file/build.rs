//! Compiles the C function that stores into a mapped file and survives its truncation.

fn main() {
    println!("cargo::rerun-if-changed=src/store.c");
    let built =
        cc::Build::new().file("src/store.c").std("c11").warnings_into_errors(true).try_compile("append_file_store");
    if let Err(error) = built {
        let error = error.to_string();
        let reason = error.lines().next().unwrap_or_default();
        println!("cargo::error=store.c did not compile ({reason}): run `./setup`, or `apt-get install g++`");
    }
}
