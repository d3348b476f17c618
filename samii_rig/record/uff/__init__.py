"""Universal files (UFF): data sets 15, 55, 58, 58b, 82, 151, 164, 2411 and 2412, both ways.

`file.UffFile` opens a file of any size at once and reads a set when it is asked for;
`file.write_uff` writes sets. `sets` says what the fields of each are called. Sets of another
number go through as the bytes that they are.

The formats are those of the Structural Dynamics Research Laboratory of the University of
Cincinnati (www.ceas3.uc.edu/sdrluff), where each is described column by column.
"""
