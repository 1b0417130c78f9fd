"""helio_jax: simulate scanning helium micrographs and reconstruct height maps from three or more of them.

```
Scene -- trace --> MicrographStack -- calibration, alignment --> MicrographStack -- inverse --> Reconstruction
                        forward: heights and optics -> expected counts, differentiable; used by inverse
```

Imports go downwards only: commands > workflows > figures > measure, scores, inverse, calibration, alignment, planning >
forward, trace, formats > scene > nouns (tests/test_architecture.py). Frames, units, physics: docs/conventions.md.
Public names are loaded on first use, so that `import helio_jax` is instant.

Where is ... the shadow mask? trace/masks (maps of a simulation), forward/masking (in a reconstruction). The integration
of slopes? inverse/integrate. A new scattering law? Its table in scene/scattering, its density in trace/lobes, its
draws in trace/laws; in a fit, forward/laws.

Module map (one line each, complete: tests/unit/test_project_files.py):

```
.                     nouns and rules
  arguments           types of the arguments of public functions
  arrays              conventions of every array; checks and small array functions
  errors              typed errors and their exit codes
  spelling            near matches of a misspelt name
  texts               TOML and JSON of untrusted files
  child               limited child processes that parse untrusted files
  validity            the rule of is_valid: reasons, limits, words
  settings            base class of all settings tables
  drawable            plot(), short repr, notebook view and to_xarray() of the records
  cpus                how many CPUs this process may use
  kernel              how inner loops are compiled (numba)
  robust              the robust weight
  block_fit           least squares with per-pixel unknowns eliminated
  detector            apertures in the plate and cones at infinity
  campaign            read-out that the scans of a measuring campaign share
  instrument          beam, plate and detectors, and the geometry that follows from them
  geometry_prior      joint prior of sample distance and aperture directions, as an instrument file states it
  micrograph          MicrographStack, MicrographSet
  heightmap           HeightMap on a regular grid
  reconstruction      Reconstruction: height, error bars, validity, reasons
  __main__            entry point of the command line
scene/                what is imaged: settings tables and geometry; no tracing
  scene               Scene: instrument, sample and scan, checked against each other
  sample              the [sample] table by kind; mesh samples
  meshes              reads mesh files (STL, OBJ, PLY, GLB)
  holes               holes of a mesh; closes small ones
  shapes              samples from numbers: flat, spheres, step, trench, pyramid
  rough               random rough samples
  maps                samples from height maps and reconstructions
  placement           scale, rotation and position of any sample
  surfaces            triangles and exact spheres of a sample; closed-form first hits
  hidden_side         where the side that the beam does not see may stand
  body                Body: triangles and spheres with material names
  border              continuation of a surface beyond its image
  waves               continuation of waves beyond an image
  midpoints           points half-way between those of a grid, by its heights and slopes
  wall_grid           grid of heights whose walls are half-way between pixels
  wall_outlines       smooth outlines of walls between pixels
  scattering          the [material] tables: scattering laws
  mtl                 scattering laws in the .mtl file of an OBJ mesh
  plates              plates from mesh files
  drill               makes the mesh of a plate with channels
  scan                the [scan] table: rasters, lines, lists of positions
  views               distances and rotations of a scan
  rays                beams from a file of rays
  files               bounded reading of scene files and of the files that a scene names
trace/                Scene -> MicrographStack by Monte Carlo (NumPy, numba, Embree); no JAX
  settings            the [trace] table
  intersect           ray-surface intersection; the only door to embreex
  source              start points and directions of the beam's atoms
  random              counter-based random numbers and low-discrepancy points
  direct              form factor of the tracer; direct detection
  lobes               each scattering distribution: trial directions and density
  laws                draw from and evaluate the law of a material
  lawtable            laws as flat arrays for the kernels
  experiment          inputs of a block and state of the atoms in flight
  transport           paths of a block of pixels, step by step
  analog              fast inner loop for cosine-law surfaces
  next_event          expected estimator: next-event estimation
  plate               underside of a scattering plate
  meshplate           plates with channels
  tally               integer fates, hits and sums
  masks               maps of masking and shadowing
  guided              multiple scattering from known points, with guided first bounces
  denoise             averaging of traced images within smooth regions
  run                 blocks of pixels on threads
  converge            rays per pixel until a target error is reached
  job                 a scan as a keyed list of units
  units               units of work
  scan                all units of a scan on threads, processes or a cluster
  follow              single atoms (helio rays)
forward/              heights and optics -> expected counts, differentiable (JAX); no optimiser
  compiling           how large JAX functions are compiled
  optics              Optics, Raster: beam, apertures and beam positions as pytrees; moving them
  surface             Surface: heights and slopes in the beam frame, normals
  known_shapes        ball, step and wedge in closed form: heights, normals, horizons
  form_factor         vector form factor of an elliptical aperture
  laws                scattering laws of single scattering: power, lobe, rough, monotone
  horizon             horizon search along a march over the surface
  masking             masked part of each form factor: the shadow mask of a reconstruction
  radiosity           multiple scattering by radiosity
  layout              layouts of apertures as optics; walls between them
  readout             Readout: gain, offset, drift, pedestal, scan lines
  render              hx.render: the render model; single scattering
inverse/              MicrographStack -> Reconstruction (JAX, optimistix)
  settings            the [reconstruct] table
  methods             entry: runs linear, nearfield or refine
  linear              linear photometric solution of every pixel
  nearfield           photometric methods at the current height
  bootstrap           error bars of the photometric methods
  integrate           slopes -> heights: chooses the integrator
  integrate_poisson   Poisson integrators and their operators
  integrate_jumps     weighted Poisson integration that cuts depth jumps
  integrate_bilateral bilateral normal integration
  integrate_sylvester integration after Harker and O'Leary
  edges               edges of the raster: smooth, kink or jump
  rims                where a dome, steepest at its rim, meets a level surface
  border_level        level of the signal on a flat border: starts where it is off
  strain              how far a fit moves the instrument from what is stated
  growth              changes that grow from iteration to iteration, which corrections follow
  geometry_change     change of a geometry stated as exact that the data ask for
  geometry_score      whether they ask for one (Rao's score test)
  wider_readout       fit of gains or offsets that are far from what is stated
  instrument_choice   choice between instruments that explain the micrographs: geometry, gains and offsets
  explanations        competing explanations of the micrographs, each fitted; the best is kept
  photometric_start   surfaces that a fit starts from
  backtracking        a step halved until its surface can be traced
  objects             objects on a flat substrate: their outlines and levels
  pits                pits in a flat substrate: their outlines and levels
  levels              level search of regions behind depth jumps
  merging             segmentation of a noisy map by region merging
  albedo_patches      parts of the surface of other albedo than the substrate's
  albedo_search       such parts in a measurement
  occlusion           depth jumps where the surface leaves the beam
  mask_steps          hx.find_steps: step heights from the mask bands of the micrographs
  mask_edges          masked pixels, and the upper edges at which mask bands begin
  wall_signal         signal across a vertical wall: mask, lit wall, multiple scattering
  edge_place          where an upper edge lies between the pixels
  band_fit            length of the band beside an edge, and the height from it
  mask_patches        surface patches between steps, and their levels
  patch_outlines      outlines of patches by the signals beside them
  dash_lines          lines of isolated dark pixels, which no chance explains
  low_wall            signal across a low wall that may slope
  low_steps           heights of steps whose bands are shorter than a pixel
  dash_steps          such steps as records
  shadow_steps        steps that face away from the beam, by the glow beside them
  step_records        records of steps, bands and patches
  step_parts          heights of steps along long edges, part by part
  measured_steps      what measured steps are for a fit: walls between pixels, known levels and differences of heights
  parameters          unknowns of the fit that are not the surface, their priors, what they stand for
  law_prior           what is unknown of the scattering law; its test against the cosine law
  residuals           residuals of the fit as a function of its unknowns
  problem             FitProblem: data, priors, all that is constant in a fit
  state               FitState and its corrections: all that changes
  responses           how corrections follow common changes of the heights
  steps               one least-squares step: fixed terms, solve
  solver              inexact Gauss-Newton; the only door to optimistix
  fisher              hx.fisher: what an experiment would determine
  criterion           variance of the heights as a differentiable function of the optics
  layout_objective    what a search of aperture layouts minimises
  fit                 outer iterations of the fit
  dwell_information   variance of heights as a function of dwell times
  further_images      images of a fitted surface that are not recorded yet
  convergence         convergence error and status of a fit
  posterior           Laplace posterior of heights and slopes
  correlated_errors   errors that agree between neighbours: predicted data, edges at kinks
  samples             posterior samples of the heights
  noise_bias          bias that the noise of the data causes
  dead_detectors      detectors that show no signal where the others do
  quality             why a height is not valid
  anchors             what is known of many heights together
  anchor_settings     what a user knows of the heights: tables [[reconstruct.anchor]]
  known_heights       the same, as sums of heights
  anchoring           brings a fit to them; whether each agrees with all else
  verdict             whether the data support a height map
  misfit_errors       errors of a photometric height map that its misfit shows
  instrument_report   what a fit found out about the instrument
  consistency         misfit of one surface to all images
calibration/          background, gain, drift and noise; instruments by known shapes
  border              first calibration of a measured scan from its border and dark spots
  noise_model         noise, spikes and scan-line offsets of measured images
  noise               the [noise] table: adds noise to expected counts
  response            detector lag and slow drift in scan time
  self_calibration    calibration of rotated scans by a constant albedo
  constant_albedo     the fit behind it
  known_objects       objects of known shape as a user states them
  unknowns            what is unknown in an instrument and a scan; priors
  known_model         detection probability of a known object's scan (JAX)
  known_scan          one scan of a known object: data, unknowns
  known_start         where on the raster the object lies
  known_pixels        on which part every pixel lies
  common_errors       errors that scan lines or tiles of pixels share
  known_shape         the fit of an instrument to known shapes
  shared_background   background of a campaign: joined from calibrated scans, predicted for another one
  known_report        table, chi-square by region, verdict, instrument with covariance
  mask_model          what a ball on a flat shows whatever the scattering law (JAX)
  mask_directions     directions of the apertures by the outlines of ball and masks
  mask_report         their table, verdict, instrument
alignment/            rotated scans onto one raster; orientation of arrays
  align               entry: a set of scans -> one stack
  correction          correction of a motion where heights move pixels
  rigid               rigid motions
  control_points      motions from control points
  automatic           motions by prediction and correlation
  albedo_prior        motions of smooth samples by a constant albedo
  views               scans as the automatic alignment reads them
  correlate           normalised cross-correlation with missing data
  resample            images at other positions; several scans on one raster
  added_scans         scans of one orientation added: counts and dwell times add
  orientation         rotated, mirrored and reordered images; what a file leaves open
planning/             how long an acquisition takes and what it sees, layouts of apertures: numbers in, numbers out
  timing              time of an acquisition; overhead of a measured scan
  coverage            field of view after rotation
  dwell               dwell times that minimise a variance within a given time
  positions           lists of beam positions with dwell times, in scan order
  stage               rotation centre of a stage; windows that keep a region in view
  design_settings     the [design] table
  starts              where searches of aperture layouts start; symmetric pairs
  search              local minimum with constraints
scores/               errors against something known
  settings            the [truth] table
  metrics             scores of a reconstruction against the true surface
  agreement           agreement of a simulation with measured micrographs
measure/              numbers from height maps
  facets              planar facets: angles, sides, areas
  planes              planes through regions of a height map
  sample_grid         heights of an oblique beam on a regular grid of the sample frame
  sample_surface      the surface that is measured: regular grid of the sample frame, errors, flags
  areal_filters       Gaussian S-filter and L-filter, F-operator (ISO 16610-61)
  texture             hx.measure_texture: areal surface texture of ISO 25178, with errors
  texture_parameters  height and hybrid parameters; all of them together
  material_ratio      areal material ratio curve: Sk, Spk, Svk, Smr1, Smr2
  autocorrelation     Sal, Str
  profiles            hx.measure_profile: heights along a line
  step_height         hx.measure_step_height: ISO 5436-1 type A, single steps
  spectrum            power spectra of regions
  ripple              wavelength and amplitude of a ripple
  regions             regions given by corners
  lines               thin lines and creases in micrographs
  line_paths          paths of lines
  crack_profiles      profiles across cracks
  groove_depth        depth and width of a groove
  cracks              list of cracks
  walls               list of vertical edges
  crack_text          cracks and edges as text and CSV
figures/              pictures
  canvas              the only door to matplotlib
  plot_data           arrays that panel and report share
  maps                maps of the pages: image with colour bar, relief, validity
  sheet               layout of a page in rows of cells
  panel               micrographs, heights, errors and profiles on one page
  report              HTML report
  report_page         its template, style and script
  report_text         its words and tables
  trust               verdict, rule and limits of a height map in words
  interactive         interactive views; the only door to plotly
  agreement           simulation against measurement
  known_shape         residuals of a calibration by known shapes
  mask_directions     outlines of ball and masks in the micrographs, residuals
  before_after        a scan before and after calibration
  notebook            thumbnail and table of a record
  micrograph_page     page of micrographs and apertures
  scene_page          page of a scene before any tracing
  height_page         page of a height map
  instrument_page     page of an instrument
  instrument_views    plan view and side view of an instrument
  scale_bar           scale bar of a map
  text_box            rows of words on a page
  summary             what a person wants to know, in about ten lines
  image_numbers       mean, SNR and error of each image
  wording             numbers with units as a person writes them
  overlay             overlay of aligned scans; facet map
  cracks              cracks and vertical edges
  steps               mask bands and steps on the micrographs
  ripple              a ripple
  spot                the beam's spot
  sweep               scores of a study
  planning            error against time of a plan
  design              error against masked area of a design
  dwell               dwell times of a list of positions
  pick                window for control points
formats/              the only door to files
  hdf5                reads and writes stacks and reconstructions (HDF5)
  nexus               their NeXus layout
  parts               finished units on disk
  safe                checks of outputs, atomic writes
  suffixes            suffixes of files by format
  matlab              imports .mat files
  acquisition         how a measured scan was acquired: times, stage window
  matlab_reference    the reference simulator's .mat layout
  tables              what the .mat tables hold
  export              writes files of other programs; the suffix selects the format
  export_formats      the table of these formats: what each holds
  history             what of a file's history can be repeated
  as_xarray           records as xarray datasets
  layers              named arrays on one raster, which every writer takes
  write_arrays        MAT, NPZ, CSV
  write_gwyddion      GWY, GSF
  write_meshes        STL, PLY, OBJ
  write_netcdf        NetCDF
  write_png           PNG, 16-bit grey
  write_reference     the reference simulator's layout (.mat)
  write_sdf           SDF (ISO 25178-71)
  write_tiff          TIFF
  write_x3p           X3P (ISO 25178-72)
  columns             tables of columns (.csv, .npz)
  points              control points (.csv)
  anchors             known heights (.csv)
  toml                writes instrument files
  fetch               downloads public data
workflows/            what joins the stages
  pipeline            simulate, align, evaluate, report, run
  heights             calibrate, reconstruct; one scan or several
  several_scans       scans of oblique beams joined on one surface
  scene_file          scene files: TOML -> Scene
  shipped             scenes and instruments that come with the program, by name
  copy_scene          copies of those
  rerun               repeats what made a file
  starting_file       starting files of a scene and an instrument
  merge               tables over those of an extended file; lists that are added
  scene_errors        validation errors as sentences
  scene_warnings      probable mistakes that the built sample shows
  corrections         predicted masking and multiple scattering for the fit
  surface_hypotheses  meshes of a surface, with hypotheses for what the beam does not see and for what lies beyond
  calibrate_rotated   calibration of aligned rotated scans
  calibrate_known     calibration of an instrument by known shapes
  known_scene         the scene of a known object, for the tracer
  orient              finds the orientation of a file's arrays
  compare             simulation against experiment
  show                pictures of records and files: hx.show
  file_info           what a file of any kind holds: helio info
  any_file            reads a file of any kind
  effects             effects that a simulation may lack
  measure             what helio measure prints
  steps               what helio measure --steps prints
  study               sweeps of scene values
  study_file          the study file
  study_table         scores of a study, averaged, as a table
  plan                hx.plan: time and expected errors of acquisitions
  design              hx.design: layouts of apertures
  design_result       layouts that a design has found: records, ranking, files
  plan_windows        hx.plan_windows: rotation centre and stage windows
  next_scan           hx.next_scan: where to spend the next second
  export              hx.export: formats of other programs, heights on a grid on request
  checkpoint          long simulations that can be resumed
  truth               the true surface of a scene
  spot                the beam's spot
  validate            what helio validate checks
  provenance          how a result was made
  compilation_cache   keeps what JAX compiles
  doctor              checks the installation
commands/             the command line; no logic of its own
  app                 shared options and messages
  group               the group of all commands; makes each when it is asked for
  door                checks outputs against inputs before any work
  interrupts          Ctrl-C at any moment
  log                 the log file of a command (--log)
  simulating          run, simulate, rays, resume, rerun, study, spot, plate
  looking             show, info
  heights             reconstruct, evaluate, measure, report
  measured            import, export, compare, align, pick, calibrate, orient
  planning            plan, plan-windows, design, next
  scenes              scenes, init, validate, schema
  about               doctor, fetch-data, cite
```
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Instrument": "instrument",
    "MicrographStack": "micrograph",
    "MicrographSet": "micrograph",
    "HeightMap": "heightmap",
    "Reconstruction": "reconstruction",
    "HelioError": "errors",
    "Optics": "forward.optics",
    "Raster": "forward.optics",
    "Surface": "forward.surface",
    "surface_of_heights": "forward.surface",
    "Readout": "forward.readout",
    "drift_modes": "forward.readout",
    "pedestal_modes": "forward.readout",
    "Corrections": "forward.render",
    "PowerLaw": "forward.laws",
    "LobeLaw": "forward.laws",
    "RoughLaw": "forward.laws",
    "MonotoneLaw": "forward.laws",
    "render": "forward.render",
    "plan_radiosity": "forward.radiosity",
    "Information": "inverse.fisher",
    "fisher": "inverse.fisher",
    "posterior_std": "inverse.fisher",
    "find_steps": "inverse.mask_steps",
    "measure_profile": "measure.profiles",
    "measure_step_height": "measure.step_height",
    "measure_texture": "measure.texture",
    "design": "workflows.design",
    "plan": "workflows.plan",
    "plan_windows": "workflows.plan_windows",
    "next_scan": "workflows.next_scan",
    "add_scans": "alignment.added_scans",
    "add_positions": "alignment.added_scans",
    "load_scene": "workflows.scene_file",
    "load_instrument": "workflows.scene_file",
    "simulate": "workflows.pipeline",
    "reconstruct": "workflows.heights",
    "reconstruct_scans": "workflows.heights",
    "true_height": "workflows.truth",
    "show": "workflows.show",
    "evaluate": "workflows.pipeline",
    "run": "workflows.pipeline",
    "read": "formats.hdf5",
    "write": "formats.hdf5",
    "import_micrographs": "formats.matlab",
    "export": "workflows.export",
}

__all__ = [*sorted(_HOME), "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"helio_jax.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'helio_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
