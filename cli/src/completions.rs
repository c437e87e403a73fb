use clap::{Args, CommandFactory as _};
use clap_complete::Shell;

use crate::Cli;
use crate::failure::Failure;
use crate::output;

/// Print a shell script that completes commands, options and names
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary completions bash > ~/.local/share/bash-completion/completions/aviary
  aviary completions zsh > ~/.zfunc/_aviary
  aviary completions fish > ~/.config/fish/completions/aviary.fish")]
pub struct Completions {
    /// Shell
    shell: Shell,
}

impl Completions {
    pub fn run(&self) -> Result<(), Failure> {
        let mut text = Vec::new();
        clap_complete::generate(self.shell, &mut Cli::command(), "aviary", &mut text);
        output::print(&String::from_utf8_lossy(&text))
    }
}
