//! Program `regrind`: parses arguments, runs a command, returns an exit code.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
