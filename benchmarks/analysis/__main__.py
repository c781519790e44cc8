from benchmarks.analysis.tightness import main

main()
