//! Compiles the kernels of every core's network for some compute capabilities, without a GPU:
//! `compile_kernels FOLDER 80 90` writes `NAME.ptx` and `NAME.cubin`.

use std::{error::Error, fs, path::PathBuf};

use eddy_cuda::{
    gpu::{Target, compile},
    kernels::{Constants, SOURCE},
};
use eddy_inference::checkpoint::{Activation, Form, Pooling};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder =
        PathBuf::from(arguments.next().ok_or("expected a folder and compute capabilities")?);
    fs::create_dir_all(&folder)?;
    let capabilities: Vec<u32> = arguments.map(|word| word.parse()).collect::<Result<_, _>>()?;
    let paper = Constants {
        particles: 2500,
        one_hot: true,
        encoder: 256,
        hidden: 1250,
        activation: Activation::Elu,
        pooling: Pooling::Mean,
        form: Form::Plain,
        normalized: true,
    };
    let log = Constants { form: Form::Log, normalized: false, one_hot: false, ..paper.clone() };
    let maximum = Constants { pooling: Pooling::MeanMax, ..paper.clone() };
    let variants = [("paper", paper.clone()), ("log", log), ("maximum", maximum)];
    let variants = variants.into_iter().chain(
        Activation::ALL.map(|kind| (kind.name(), Constants { activation: kind, ..paper.clone() })),
    );
    for (name, constants) in variants {
        for &capability in &capabilities {
            for (target, extension) in
                [(Target::Ptx(capability), "ptx"), (Target::Machine(capability), "cubin")]
            {
                let image = compile(SOURCE, &constants.definitions(), target)?;
                let file = folder.join(format!("{name}.{capability}.{extension}"));
                println!("{}: {} bytes", file.display(), image.len());
                fs::write(file, image)?;
            }
        }
    }
    Ok(())
}
