//! Compiles the kernels of every core's network for some compute capabilities, without a GPU:
//! `compile_kernels FOLDER 80 90` writes `NAME.CAPABILITY.ptx`.

use std::{
    error::Error,
    fs,
    num::NonZeroUsize,
    path::PathBuf,
    sync::atomic::{AtomicUsize, Ordering},
    thread,
};

use eddy_cuda::{
    CudaError, dense,
    gpu::{Target, compile},
    kernels::{Constants, Program},
    particle, solver,
};
use eddy_inference::checkpoint::{
    Activation, Architecture, Core, Description, Form, FrameOutput, MATERIAL_INPUTS, Pooling, Sizes,
};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder =
        PathBuf::from(arguments.next().ok_or("expected a folder and compute capabilities")?);
    fs::create_dir_all(&folder)?;
    let capabilities: Vec<u32> = arguments.map(|word| word.parse()).collect::<Result<_, _>>()?;
    let programs: Vec<_> = programs()?
        .into_iter()
        .map(|(name, program)| (name, program.checked_source(), program.definitions()))
        .collect();
    let all: Vec<_> = programs
        .iter()
        .flat_map(|program| capabilities.iter().map(move |&capability| (program, capability)))
        .collect();
    let next = AtomicUsize::new(0);
    let work = || -> Result<(), String> {
        while let Some(&((name, source, definitions), capability)) =
            all.get(next.fetch_add(1, Ordering::Relaxed))
        {
            let image = compile(source, definitions, Target::Ptx(capability))
                .map_err(|error| error.to_string())?;
            let file = folder.join(format!("{name}.{capability}.ptx"));
            println!("{}: {} bytes", file.display(), image.len());
            fs::write(file, image).map_err(|error| error.to_string())?;
        }
        Ok(())
    };
    thread::scope(|scope| {
        let count = thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let threads: Vec<_> = (0..count).map(|_| scope.spawn(work)).collect();
        threads
            .into_iter()
            .try_for_each(|thread| thread.join().map_err(|_| "a thread has panicked".to_owned())?)
    })?;
    Ok(())
}

/// A program and the name of its file.
type Named = (String, Box<dyn Program>);

/// The programs of all networks.
fn programs() -> Result<Vec<Named>, CudaError> {
    let paper = Constants {
        particles: 2500,
        one_hot: true,
        encoder: 256,
        hidden: 1250,
        core: Core::MinGru,
        activation: Activation::Elu,
        pooling: Pooling::Mean,
        output: FrameOutput::Displacement,
        form: Form::Plain,
        normalized: true,
        material_inputs: MATERIAL_INPUTS,
    };
    let log = Constants { form: Form::Log, one_hot: false, ..paper.clone() };
    let unnormalized = Constants { core: Core::MinLstm, normalized: false, ..log.clone() };
    let maximum = Constants { pooling: Pooling::MeanMax, ..paper.clone() };
    let variants = [("log", log), ("unnormalized", unnormalized), ("maximum", maximum)];
    let variants = variants
        .into_iter()
        .chain(Core::ALL.map(|core| (core.name(), Constants { core, ..paper.clone() })));
    let variants = variants.chain(
        Activation::ALL.map(|kind| (kind.name(), Constants { activation: kind, ..paper.clone() })),
    );
    let variants = variants.chain(
        FrameOutput::ALL.map(|kind| (kind.name(), Constants { output: kind, ..paper.clone() })),
    );
    let frame = variants
        .map(|(name, constants)| (name.to_owned(), Box::new(constants) as Box<dyn Program>));
    // The default network's widths, and those of a wide one.
    let particle = Core::ALL.into_iter().flat_map(|core| [(core, 16, 24), (core, 64, 128)]);
    let particle = particle.map(|(core, encoder, hidden)| {
        let sizes = Sizes { encoder, hidden, layers: 1, particles: None };
        let description = Description::untrained(Architecture::Particle, core, sizes);
        let constants = particle::Constants::of(&description)?;
        let name = format!("particle-{}-{hidden}", core.name());
        Ok((name, Box::new(constants) as Box<dyn Program>))
    });
    let particle = particle.collect::<Result<Vec<_>, CudaError>>()?;
    let learning = Core::ALL.map(|core| (core, 16, 24)).into_iter().chain([(Core::Lstm, 64, 128)]);
    let learning =
        learning.map(|(core, encoder, hidden)| (core, encoder, hidden, vec![32, 64, 64]));
    let learning = learning.chain([(Core::MinGru, 16, 24, vec![24, 32, 48, 64])]);
    let learning = learning.map(|(core, encoder, hidden, channels)| {
        let sizes = Sizes { encoder, hidden, layers: 1, particles: None };
        let mut description = Description::untrained(Architecture::Particle, core, sizes);
        let levels = channels.len();
        description.grid.iter_mut().for_each(|grid| grid.channels = channels.clone());
        // One variant covers both four levels of the grid and the stiffness as an input.
        description.stiffness = levels > 3;
        let constants = particle::TrainingConstants::of(&description)?;
        let name = format!("training-{}-{hidden}-{levels}", core.name());
        Ok((name, Box::new(constants) as Box<dyn Program>))
    });
    let learning = learning.collect::<Result<Vec<_>, CudaError>>()?;
    let solver = ("solver".to_owned(), Box::new(solver::Constants) as Box<dyn Program>);
    let dense = Activation::ALL.map(|activation| {
        let constants = dense::Constants { width: 200, activation };
        (format!("dense-{}", activation.name()), Box::new(constants) as Box<dyn Program>)
    });
    Ok(frame.chain(particle).chain(learning).chain([solver]).chain(dense).collect())
}
